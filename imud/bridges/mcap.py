"""Writer of an MCAP file (https://mcap.dev/spec). The output does not need to be seekable.

    magic │ header │ metadata │ chunk, indexes of its messages │ chunk, … │ data end │ summary │ footer │ magic

A thread compresses a chunk of some thousand messages with Zstandard while the writer fills the next chunk. The library
`mcap` encodes the records. This module encodes messages and their indexes, because the library takes several
microseconds per message, and a sample has four messages. `mcap recover` reads the complete chunks of a truncated file.
"""

import struct
import zlib
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import accumulate, chain, count, repeat
from typing import Any, Final

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from imud.bridges.channel import ByteWriter, MessageChannel, MessageSchema
from imud.formats.zstandard import FrameEncoder

# Size of a chunk, bytes, as in the writer of the library. Larger chunks save 2 %, but a reader of one second of a topic
# must unpack a complete chunk.
CHUNK_BYTES: Final = 1 << 20
LEVEL: Final = 1  # Compression level of Zstandard. Level 3 saves little for noisy numbers and takes twice the time.
TIME_MAX: Final = (1 << 64) - 1
# Header of a message: opcode, length of the rest, channel, sequence number, log time, publish time
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_MESSAGE_REST: Final = _MESSAGE.size - 9
_SEQUENCE_MASK: Final = 0xFFFF_FFFF


class McapChannel:
    """Channel of a file. `McapFile.add_channel` creates it."""

    __slots__ = ("_file", "count", "id", "index")

    def __init__(self, file: "McapFile", number: int) -> None:
        self._file = file
        self.id = number
        self.count = 0  # number of messages so far
        self.index: list[int] = []  # time and position of each message in the current chunk

    def add(self, t_ns: int, data: bytes) -> None:
        """Append a message. `t_ns`: ns since 1970; an earlier time becomes 0. Raises OSError."""
        t_ns = min(max(t_ns, 0), TIME_MAX)
        head = _MESSAGE.pack(
            Opcode.MESSAGE, _MESSAGE_REST + len(data), self.id, self.count & _SEQUENCE_MASK, t_ns, t_ns
        )
        self.count += 1
        self._file.append(self.index, t_ns, head, data)

    def add_run(self, times_ns: Sequence[int], messages: Sequence[bytes]) -> None:
        """Append messages with their times. The result is equal to calls of `add`. Raises OSError."""
        # fast path: most runs fit in the current chunk; C code packs them without a Python call per message
        sizes = list(map(len, messages))
        fits = self._file.has_room(sum(sizes) + len(sizes) * _MESSAGE.size)
        if not (fits and min(times_ns) >= 0 and max(times_ns) <= TIME_MAX and self.count + len(sizes) < _SEQUENCE_MASK):
            for t_ns, data in zip(times_ns, messages, strict=True):
                self.add(t_ns, data)
            return
        lengths = map(_MESSAGE_REST.__add__, sizes)
        heads = map(
            _MESSAGE.pack, repeat(Opcode.MESSAGE), lengths, repeat(self.id), count(self.count), times_ns, times_ns
        )
        self.count += len(sizes)
        self._file.append_run(self.index, times_ns, list(heads), messages, sizes)


class McapFile:
    """Writer of one file. Synchronization: one thread; a second thread compresses."""

    def __init__(self, out: ByteWriter, profile: str, library: str, metadata: Mapping[str, str]) -> None:
        """`metadata`: names and values for the complete file. Raises OSError."""
        self._out = out
        self._at = 0  # number of written bytes
        self._schemas: dict[MessageSchema, Schema] = {}
        self._channels: list[tuple[Channel, McapChannel]] = []
        self._parts: list[bytes] = []
        self._size = 0
        self._chunks: list[ChunkIndex] = []
        self._encoder = FrameEncoder(LEVEL)
        self._thread = ThreadPoolExecutor(1, "compress")
        # Chunk that the thread compresses: result, size, CRC, and the message indexes by channel
        self._waiting: tuple[Future[bytes], int, int, dict[int, list[int]]] | None = None
        self._start_ns, self._end_ns = TIME_MAX, 0
        self._write(MCAP0_MAGIC)
        self._record(Header(profile, library))
        begin = self._at
        self._record(Metadata("imud", dict(metadata)))
        self._metadata = MetadataIndex(begin, self._at - begin, "imud")

    def add_channel(self, described: MessageChannel[Any]) -> McapChannel:
        """Add a channel to the file and return it."""
        schema = self._schemas.get(described.schema)
        if schema is None:
            name, encoding, data = described.schema
            schema = self._schemas[described.schema] = Schema(len(self._schemas) + 1, data, encoding, name)
            self._append(_bytes_of(schema))
        number = len(self._channels) + 1
        record = Channel(number, described.topic, described.message_encoding, {}, schema.id)
        channel = McapChannel(self, number)
        self._channels.append((record, channel))
        self._append(_bytes_of(record))
        return channel

    def append(self, index: list[int], t_ns: int, head: bytes, data: bytes) -> None:
        """Append a message, and its time and position to `index`. Only `McapChannel` calls this method."""
        index += (t_ns, self._size)
        self._parts += (head, data)
        self._size += len(head) + len(data)
        if self._size >= CHUNK_BYTES:
            self._end_chunk()

    def has_room(self, size: int) -> bool:
        """Return whether the current chunk stays open after `size` more bytes."""
        return self._size + size < CHUNK_BYTES

    def append_run(
        self,
        index: list[int],
        times_ns: Sequence[int],
        heads: Sequence[bytes],
        messages: Sequence[bytes],
        sizes: Sequence[int],
    ) -> None:
        """Append messages that fit in the current chunk, and their times and positions to `index`."""
        *places, self._size = accumulate(map(_MESSAGE.size.__add__, sizes), initial=self._size)
        index += chain.from_iterable(zip(times_ns, places, strict=True))
        self._parts += chain.from_iterable(zip(heads, messages, strict=True))

    def finish(self) -> None:
        """Write the last chunk and the summary. The file stays open. Raises OSError."""
        self._end_chunk()
        self._write_waiting()
        self._thread.shutdown()
        # 0: no CRC of the data section; each chunk has a CRC
        self._record(DataEnd(0))
        self._write_summary()
        self._write(MCAP0_MAGIC)

    def close(self) -> None:
        """Stop the thread. Without `finish`, the file is truncated. A second call does nothing."""
        self._thread.shutdown(cancel_futures=True)

    # --- chunks ------------------------------------------------------------------------------------------------------

    def _append(self, data: bytes) -> None:
        self._parts.append(data)
        self._size += len(data)

    def _end_chunk(self) -> None:
        if not self._parts:
            return
        content = b"".join(self._parts)
        self._parts, self._size = [], 0
        indexes = {}
        for _, channel in self._channels:
            if channel.index:
                indexes[channel.id] = channel.index
                channel.index = []
        self._write_waiting()
        compressed = self._thread.submit(self._encoder.encode, content)
        self._waiting = compressed, len(content), zlib.crc32(content), indexes

    def _write_waiting(self) -> None:
        """Write the compressed chunk and the indexes of its messages."""
        if self._waiting is None:
            return
        compressed, size, crc, indexes = self._waiting
        self._waiting = None
        start_ns = min((min(index[::2]) for index in indexes.values()), default=0)
        end_ns = max((max(index[::2]) for index in indexes.values()), default=0)
        if indexes:
            self._start_ns, self._end_ns = min(self._start_ns, start_ns), max(self._end_ns, end_ns)
        begin, data = self._at, compressed.result()
        self._record(Chunk("zstd", data, end_ns, start_ns, crc, size))
        length, places = self._at - begin, {}
        for number, index in indexes.items():
            places[number] = self._at
            count = len(index)
            self._write(struct.pack(f"<BQHI{count}Q", Opcode.MESSAGE_INDEX, 6 + 8 * count, number, 8 * count, *index))
        self._chunks.append(
            ChunkIndex(length, begin, "zstd", len(data), end_ns, self._at - begin - length, places, start_ns, size)
        )

    # --- the end -----------------------------------------------------------------------------------------------------

    def _write_summary(self) -> None:
        begin, summary, offsets = self._at, b"", b""
        groups: tuple[tuple[Opcode, list[McapRecord]], ...] = (
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, [record for record, _ in self._channels]),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, list(self._chunks)),
            (Opcode.METADATA_INDEX, [self._metadata]),
        )
        for opcode, members in groups:
            group = b"".join(map(_bytes_of, members))
            if group:
                offsets += _bytes_of(SummaryOffset(opcode, begin + len(summary), len(group)))
                summary += group
        offsets_at = begin + len(summary)
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, begin, offsets_at)
        crc = zlib.crc32(footer, zlib.crc32(offsets, zlib.crc32(summary)))
        self._write(summary + offsets)
        self._record(Footer(begin, offsets_at, crc))

    def _statistics(self) -> Statistics:
        counts = {channel.id: channel.count for _, channel in self._channels}
        total = sum(counts.values())
        start_ns = self._start_ns if total else 0
        return Statistics(
            0, len(self._channels), counts, len(self._chunks), total, self._end_ns, start_ns, 1, len(self._schemas)
        )

    def _record(self, record: McapRecord) -> None:
        self._write(_bytes_of(record))

    def _write(self, data: bytes) -> None:
        self._out.write(data)
        self._at += len(data)


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call] # the library has no type hints
    return data
