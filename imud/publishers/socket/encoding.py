"""Samples as socket messages: one encoding object per form, made once per batch for all clients that want that form."""

from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Final, Protocol

from imud.contracts.publisher import Batch
from imud.formats.jsonrpc import FRAME_HEADER, encode, encode_notification, frame_of, line_of, with_texts
from imud.formats.slot import SLOT_BYTES
from imud.frames.conventions import Convention
from imud.sample import Sample

ALWAYS_FIELDS: Final = ("device", "seq", "t_ns")
"""Members of every JSON sample, whatever was selected: without them it cannot be identified."""
MESSAGE_GUESS_BYTES: Final = 700
"""What a sample with the values of a whole HI91 message has as JSON."""
_HEAD: Final = b'{"jsonrpc":"2.0","method":"sample","params":'
_TAIL: Final = b"}"
_SLOT_HEADER: Final = FRAME_HEADER.pack(SLOT_BYTES)


class Encoding(Protocol):
    """Makes messages of samples. One message is one sample, so that a queue can drop by the sample."""

    @property
    def message_bytes(self) -> int:
        """Size of the message that was encoded last; a guess before the first."""
        ...

    def encode(self, batch: Batch) -> list[bytes]:
        """Every sample of the batch as a message."""
        ...

    def encode_one(self, batch: Batch, index: int) -> bytes:
        """One sample of the batch as a message."""
        ...

    def with_dropped(self, message: bytes, device: str, dropped: Mapping[str, int]) -> bytes:
        """`message`, of `device`, with the number of samples dropped before it, by device."""
        ...


class JsonEncoding:
    """`sample` notifications, all members or the selected ones, as lines or as frames."""

    def __init__(self, fields: tuple[str, ...] | None, framed: bool, texts: bool = False) -> None:
        """`texts`: integers that may exceed 2⁵³ are text."""
        self._texts = texts
        self._wrap = frame_of if framed else line_of
        self._select = None if fields is None else selector(fields)
        self._last: bytes = bytes(MESSAGE_GUESS_BYTES)

    @property
    def message_bytes(self) -> int:
        """Size of the notification that was encoded last."""
        return len(self._last)

    def encode(self, batch: Batch) -> list[bytes]:
        """Every sample of the batch as a notification."""
        messages = [self._message(sample) for sample in batch.samples]
        self._last = messages[-1]
        return messages

    def encode_one(self, batch: Batch, index: int) -> bytes:
        """One sample of the batch as a notification."""
        self._last = self._message(batch.samples[index])
        return self._last

    def with_dropped(self, message: bytes, device: str, dropped: Mapping[str, int]) -> bytes:
        """Add the device's own number as a member of the sample, and put notifications of the others before it."""
        notices = [_dropped_notice(name, count, self._wrap) for name, count in dropped.items() if name != device]
        own = dropped.get(device)
        if own is not None:
            body = message[message.index(_HEAD) :].rstrip(b"\n")
            message = self._wrap(b'%b,"dropped":%d}}' % (body[:-2], own))
        return b"".join((*notices, message))

    def _message(self, sample: Sample) -> bytes:
        shown: object = self._select(sample) if self._select else sample
        return self._wrap(_HEAD + encode(with_texts(shown) if self._texts else shown) + _TAIL)


class BinaryEncoding:
    """Frames of one slot each."""

    message_bytes = FRAME_HEADER.size + SLOT_BYTES

    def encode(self, batch: Batch) -> list[bytes]:
        """Every sample of the batch as a frame."""
        slots = batch.slots()
        if len(slots) == 1:  # the usual case, without a call for the list
            return [_SLOT_HEADER + slots[0]]
        return [_SLOT_HEADER + slot for slot in slots]

    def encode_one(self, batch: Batch, index: int) -> bytes:
        """One sample of the batch as a frame."""
        return _SLOT_HEADER + batch.slots()[index]

    def with_dropped(self, message: bytes, device: str, dropped: Mapping[str, int]) -> bytes:
        """Put `dropped` notifications before the slot."""
        return b"".join((*(_dropped_notice(name, count, frame_of) for name, count in dropped.items()), message))


class ConvertedEncoding:
    """Another encoding, of samples in a convention that the client asked for."""

    def __init__(self, encoding: Encoding, convention: Convention) -> None:
        self._encoding = encoding
        self._convention = convention

    @property
    def message_bytes(self) -> int:
        """Size of the message that was encoded last."""
        return self._encoding.message_bytes

    def encode(self, batch: Batch) -> list[bytes]:
        """Every sample of the batch as a message."""
        return self._encoding.encode(batch.converted(self._convention))

    def encode_one(self, batch: Batch, index: int) -> bytes:
        """One sample of the batch as a message."""
        return self._encoding.encode_one(batch.converted(self._convention), index)

    def with_dropped(self, message: bytes, device: str, dropped: Mapping[str, int]) -> bytes:
        """Add the number of samples dropped, as the other encoding does."""
        return self._encoding.with_dropped(message, device, dropped)


def selector(fields: tuple[str, ...]) -> Callable[[Sample], dict[str, object]]:
    """Return a function that gives the selected members of a sample and ALWAYS_FIELDS; absent ones are left out."""
    names = tuple(dict.fromkeys((*ALWAYS_FIELDS, *fields)))
    values = attrgetter(*names)

    def select(sample: Sample) -> dict[str, object]:
        pairs = zip(names, values(sample), strict=True)
        return {name: value for name, value in pairs if value is not None}

    return select


def _dropped_notice(device: str, count: int, wrap: Callable[[bytes], bytes]) -> bytes:
    return wrap(encode_notification("dropped", {"device": device, "dropped": count}))
