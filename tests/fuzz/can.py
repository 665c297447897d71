"""All CAN codecs: for any frames of any device, a codec raises no exception and its ledger balances.

An input is a list of frames. A frame is: its identifier, the time since the previous frame in steps of STEP_NS, the
number of data bytes, and the data. An identifier below OWN selects one of the device's identifiers. Otherwise, four
bytes follow, with bit 31 for 29 bits.
"""

from collections.abc import Iterable, Sequence
from random import Random

from imud.contracts.driver import CanDriver
from imud.formats.can import EXTENDED_ID_MAX, STANDARD_ID_MAX, CanFrame
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.testing.invariants import check_closed, feed_frames, finite
from tests.fuzz.drivers import names_of, row, variants
from tests.fuzz.target import FRAMES_BYTES_MAX, Target

OWN = 240  # lower values select an identifier of the device
STEP_NS = 250_000  # 250 us
PERIOD_STEPS = 40  # 10 ms: the period of a sample at 100 Hz
SETS = 12  # samples per seed
EXTENDED_BIT = 1 << 31


def names() -> Sequence[str]:
    return names_of(CanDriver)


def make(name: str) -> Target:
    driver = row(name, CanDriver)
    choices = variants(driver.settings)
    own = own_identifiers(driver)
    partial = "NaN" in driver.euler_convention  # some devices send one angle without the others

    def run(data: bytes) -> None:
        if not data:
            return
        settings = choices[data[0] % len(choices)]
        first, second = (driver.make_codec(Ledger(), settings) for _ in range(2))
        frames = decoded(data[1:], own)
        events = feed_frames(first, frames)
        assert feed_frames(second, frames) == events
        assert all(finite(event, partial) for event in events if isinstance(event, Measurement))
        for frame in frames:
            driver.node_of(frame.can_id, frame.extended, frame.data)
        first.flush()
        check_closed(first.ledger)
        first.reset()
        assert first.ledger.frames_pending == first.ledger.bytes_pending == 0
        check_closed(first.ledger)

    return Target(run, lambda: seeds(driver, own), bytes_max=FRAMES_BYTES_MAX)


def own_identifiers(driver: CanDriver) -> list[tuple[int, bool]]:
    frames = [(frame.can_id, frame.extended) for frame in driver.example_frames(Random(1))]
    wanted = [(wanted.can_id, wanted.extended) for wanted in driver.filters(driver.settings())]
    return list(dict.fromkeys([*frames, *wanted]))


def decoded(data: bytes, own: Sequence[tuple[int, bool]]) -> list[CanFrame]:
    """Return the frames of an input without an incomplete frame at its end."""
    frames: list[CanFrame] = []
    at, t_ns = 0, 0
    while at + 3 <= len(data):
        which, steps, size = data[at], data[at + 1], min(data[at + 2], 8)
        at += 3
        t_ns += steps * STEP_NS
        if which < OWN:
            can_id, extended = own[which % len(own)]
        else:
            word = int.from_bytes(data[at : at + 4], "little")
            extended = bool(word & EXTENDED_BIT)
            can_id = word & (EXTENDED_ID_MAX if extended else STANDARD_ID_MAX)
            at += 4
        frames.append(CanFrame(can_id, extended, data[at : at + size], t_ns))
        at += size
    return frames


def encoded(frames: Iterable[tuple[int, CanFrame]], own: Sequence[tuple[int, bool]]) -> bytes:
    """Return the input for frames, each with its distance from the previous frame."""
    parts = [b"\0"]
    for steps, frame in frames:
        identifier = frame.can_id, frame.extended
        head = bytes([own.index(identifier) if identifier in own else OWN, steps, len(frame.data)])
        word = b"" if identifier in own else (frame.can_id | frame.extended * EXTENDED_BIT).to_bytes(4, "little")
        parts.append(head + word + frame.data)
    return b"".join(parts)


def seeds(driver: CanDriver, own: Sequence[tuple[int, bool]]) -> list[bytes]:
    random = Random(1)
    whole = [_set(driver, random, count) for count in (1, 2, SETS)]
    missing = [row for number, row in enumerate(_set(driver, random, SETS)) if number % 5]
    repeated = [pair for pair in _set(driver, random, 3) for _ in range(2)]
    other = [(1, CanFrame(random.randrange(2048), False, random.randbytes(8), 0)) for _ in range(5)]
    each = [[(1, CanFrame(*identifier, random.randbytes(8), 0))] * 2 for identifier in own]
    return [encoded(frames, own) for frames in (*whole, missing, repeated, other, [*other, *whole[1]], *each)]


def _set(driver: CanDriver, random: Random, count: int) -> list[tuple[int, CanFrame]]:
    rows: list[tuple[int, CanFrame]] = []
    for _ in range(count):
        frames = driver.example_frames(random)
        rows += [(1 if place else PERIOD_STEPS - len(frames) + 1, frame) for place, frame in enumerate(frames)]
    return rows
