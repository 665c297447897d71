"""Answers to `devices`, `status` and `schema`: made in pieces, a few devices or clients in each turn.

The state of 256 devices takes several milliseconds to gather and encode, ten more with big numbers as text: too long
for one turn of the event loop, in which no sample is read. Each device's state is encoded when it is taken, so a piece
is bounded and what is left for the last one is to put bytes together. A device's state is whole in itself; those of two
devices may be some turns apart, and one that is removed in between is left out.
"""

from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from typing import Final

import msgspec

from imud.contracts.status import LATENCY_BOUNDS_NS, DeviceState, DeviceStatus
from imud.formats.jsonrpc import PROTOCOL, encode, with_texts
from imud.formats.slot import PRESENT_BITS, SLOT_BYTES, SLOT_FIELDS, SLOT_LAYOUT_VERSION, SYNC_CODES
from imud.publishers.socket.connection import Connection
from imud.publishers.socket.hub import Hub
from imud.publishers.socket.messages import DeviceFrame, DeviceSummary, NoParams, SchemaResult, SlotMember, SlotSchema
from imud.publishers.socket.outbox import NO_FD
from imud.sample import SAMPLE_SCHEMA

DEVICES_PER_PIECE: Final = 8
"""About 0.3 ms; 0.5 ms with big numbers as text."""
CLIENTS_PER_PIECE: Final = 64
"""About as long: their state is small."""


@dataclass(frozen=True, slots=True)
class Answer:
    """What a method answers."""

    result: object
    fd: int = NO_FD
    """A descriptor whose copy goes with the reply."""
    framed_from_here: bool = False
    """Whether everything after this reply goes out as frames."""
    big_numbers: bool = True
    """Whether integers in it may exceed 2⁵³ and are not text yet; names of members are no data then."""


Pieces = Generator[int, None, Answer]
"""An answer that is made in pieces; each yields the bytes that it holds by then."""


def devices(hub: Hub, connection: Connection, _params: NoParams) -> Pieces:
    """The devices, each in one line."""
    rings = hub.context.rings
    lines = (
        DeviceSummary(
            one.name, one.device_id, one.driver, one.link, one.state, one.problem, one.identity, one.rate_hz,
            one.clock.sync, rings.get(one.name),
        )
        for one in hub.context.each_status()
    )  # fmt: skip
    made = yield from _encoded(lines, DEVICES_PER_PIECE, connection.text_numbers)
    return Answer(made, big_numbers=False)


def status(hub: Hub, connection: Connection, _params: NoParams) -> Pieces:
    """The full state: each device with its clock and ledger, the socket with its clients."""
    texts = connection.text_numbers
    made = yield from _encoded(hub.context.each_status(), DEVICES_PER_PIECE, texts)
    held_bytes = sum(map(len, made))
    clients = yield from _encoded(hub.each_client(), CLIENTS_PER_PIECE, texts, held_bytes)
    now_ns = hub.context.now_ns()
    socket = msgspec.structs.asdict(hub.status(())) | {"clients": clients}
    return Answer({"now_ns": str(now_ns) if texts else now_ns, "devices": made, "socket": socket}, big_numbers=False)


def schema(hub: Hub, _connection: Connection, _params: NoParams) -> Pieces:
    """What the members of samples mean, per device where that differs, and how a slot is laid out."""
    names: list[str] = []

    def frames() -> Iterator[DeviceFrame]:
        for device in hub.context.each_status():
            names.append(device.name)
            yield _frame_of(device)

    made = yield from _encoded(frames(), DEVICES_PER_PIECE, texts=False)
    bounds, states = list(LATENCY_BOUNDS_NS), list(DeviceState)
    result = SchemaResult(PROTOCOL, list(SAMPLE_SCHEMA), {}, SLOT_SCHEMA, bounds, states)
    of_devices = {"devices": dict(zip(names, made, strict=True))}
    return Answer(msgspec.structs.asdict(result) | of_devices, big_numbers=False)


def _encoded(
    values: Iterable[object], per_piece: int, texts: bool, held_bytes: int = 0
) -> Generator[int, None, list[msgspec.Raw]]:
    """Encode values, so many in each piece; `held_bytes` are those that the answer holds before."""
    made: list[msgspec.Raw] = []
    for value in values:
        if made and not len(made) % per_piece:
            yield held_bytes
        body = encode(with_texts(value) if texts else value)
        held_bytes += len(body)
        made.append(msgspec.Raw(body))
    return made


def _frame_of(device: DeviceStatus) -> DeviceFrame:
    """Axes and angles of a device's samples; without a known driver only that."""
    known = DeviceFrame(device.driver, device.euler_convention, device.navigation_frame, device.status_bit_names)
    frame = device.frame
    if frame is not None:
        known.frame, known.convention, known.heading = frame.frame, frame.convention, frame.heading
        known.declination_deg, known.conventions = frame.declination_deg, frame.conventions
    return known


SLOT_SCHEMA: Final = SlotSchema(
    bytes=SLOT_BYTES,
    layout_version=SLOT_LAYOUT_VERSION,
    byte_order="little",
    fields=[SlotMember(f.name, f.code, f.count, f.offset) for f in SLOT_FIELDS],
    present_bits=dict(PRESENT_BITS),
    sync_codes={str(name): code for name, code in SYNC_CODES.items()},
)
