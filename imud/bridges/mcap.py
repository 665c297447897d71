"""A file of MCAP (https://mcap.dev/spec), written from its begin to its end, seekable or not.

    magic │ header │ metadata │ chunk, indexes of its messages │ chunk, … │ data end │ summary │ footer │ magic

Chunks are compressed with Zstandard in a thread of their own, while the next is gathered; a chunk keeps some thousand
messages. Records are those of the library `mcap`; only messages and their indexes are packed here, because the library
takes several microseconds for a message and a sample has four. A file that is cut short has all chunks before the cut,
as `mcap recover` reads them.
"""

import struct
import zlib
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import accumulate, chain, count, repeat
from typing import Any, Final

import zstandard
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

CHUNK_BYTES: Final = 1 << 20
"""Content of a chunk, as the library's own writer has it: larger ones are compressed 2 % better, and a reader of a
second of one topic has to unpack a whole chunk."""
LEVEL: Final = 1
"""Of Zstandard: level 3 saves little of numbers with noise, and takes twice as long."""
TIME_MAX: Final = (1 << 64) - 1
_MESSAGE: Final = struct.Struct("<BQHIQQ")
"""Opcode, length of what follows, channel, sequence, log time, publish time."""
_MESSAGE_REST: Final = _MESSAGE.size - 9
_SEQUENCE_MASK: Final = 0xFFFF_FFFF


class McapChannel:
    """A channel of a file, which takes its messages. Made by `McapFile.add_channel`."""

    __slots__ = ("_file", "count", "id", "index")

    def __init__(self, file: "McapFile", number: int) -> None:
        self._file = file
        self.id = number
        self.count = 0
        """Messages so far."""
        self.index: list[int] = []
        """Time and place of each message in the present chunk."""

    def add(self, t_ns: int, data: bytes) -> None:
        """Append a message of this time (ns since 1970; before it counts as 1970). Raises OSError."""
        if not 0 <= t_ns <= TIME_MAX:
            t_ns = min(max(t_ns, 0), TIME_MAX)
        head = _MESSAGE.pack(
            Opcode.MESSAGE, _MESSAGE_REST + len(data), self.id, self.count & _SEQUENCE_MASK, t_ns, t_ns
        )
        self.count += 1
        self._file.append(self.index, t_ns, head, data)

    def add_run(self, times_ns: Sequence[int], messages: Sequence[bytes]) -> None:
        """Append messages, one of each time, as `add` one after the other. Raises OSError.

        Most runs fit the present chunk, and are packed without a call of Python's for each message.
        """
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
    """Writer of one file. Synchronization: one thread; it has another to compress."""

    def __init__(self, out: ByteWriter, profile: str, library: str, metadata: Mapping[str, str]) -> None:
        """`metadata` is what is to be known of the whole file. Raises OSError."""
        self._out = out
        self._at = 0
        """Bytes written."""
        self._schemas: dict[MessageSchema, Schema] = {}
        self._channels: list[tuple[Channel, McapChannel]] = []
        self._parts: list[bytes] = []
        self._size = 0
        self._chunks: list[ChunkIndex] = []
        self._compressor = zstandard.ZstdCompressor(level=LEVEL)
        self._thread = ThreadPoolExecutor(1, "compress")
        self._waiting: tuple[Future[bytes], int, int, dict[int, list[int]]] | None = None
        """The chunk that is compressed: it, its size and CRC, and indexes of its messages by channel."""
        self._start_ns, self._end_ns = TIME_MAX, 0
        self._write(MCAP0_MAGIC)
        self._record(Header(profile, library))
        begin = self._at
        self._record(Metadata("imud", dict(metadata)))
        self._metadata = MetadataIndex(begin, self._at - begin, "imud")

    def add_channel(self, described: MessageChannel[Any]) -> McapChannel:
        """Return a channel for messages that are described so."""
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
        """Append a message, with its place to `index`; for `McapChannel`."""
        index += (t_ns, self._size)
        self._parts += (head, data)
        self._size += len(head) + len(data)
        if self._size >= CHUNK_BYTES:
            self._end_chunk()

    def has_room(self, size: int) -> bool:
        """Whether the present chunk goes on after so many bytes more."""
        return self._size + size < CHUNK_BYTES

    def append_run(
        self,
        index: list[int],
        times_ns: Sequence[int],
        heads: Sequence[bytes],
        messages: Sequence[bytes],
        sizes: Sequence[int],
    ) -> None:
        """Append messages that the present chunk has room for, with their places to `index`; for `McapChannel`."""
        *places, self._size = accumulate(map(_MESSAGE.size.__add__, sizes), initial=self._size)
        index += chain.from_iterable(zip(times_ns, places, strict=True))
        self._parts += chain.from_iterable(zip(heads, messages, strict=True))

    def finish(self) -> None:
        """Write what waits, and the summary; the file itself stays open. Raises OSError."""
        self._end_chunk()
        self._write_waiting()
        self._thread.shutdown()
        self._record(DataEnd(0))
        self._write_summary()
        self._write(MCAP0_MAGIC)

    def close(self) -> None:
        """End the thread; without `finish` the file stays cut short. May be called twice."""
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
        compressed = self._thread.submit(self._compressor.compress, content)
        self._waiting = compressed, len(content), zlib.crc32(content), indexes

    def _write_waiting(self) -> None:
        """Write the chunk that was compressed meanwhile, and the indexes of its messages."""
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
    data: bytes = builder.end()  # type: ignore[no-untyped-call] # the library has none
    return data
