"""Requirements of every stream codec, from its row in DRIVERS: any split, damage and noise, a balanced ledger."""

from collections.abc import Callable, Iterable, Sequence
from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud import drivers as devices
from imud.contracts.codec import BadFrame, BadReason, CodecEvent, StreamCodec
from imud.contracts.driver import StreamDriver, of_kind
from imud.contracts.script import TextLine
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from tests.support.codec_invariants import cut, untimed
from tests.support.codec_invariants import feed_stream as feed_checked

IDLE = 2000  # number of zero bytes that complete any claimed frame

DRIVERS = {driver.name: driver for driver in of_kind(devices.DRIVERS.values(), StreamDriver)}
every_driver = pytest.mark.parametrize("name", list(DRIVERS))


def every_driver_and_seed(test: Callable[[str, int], None]) -> Callable[..., None]:
    seeded: Callable[..., None] = every_driver(given(seed=st.integers(0, 2**32))(test))
    return seeded


def make(driver: StreamDriver) -> StreamCodec:
    return driver.make_codec(Ledger(), driver.settings())


def measurements(events: Iterable[CodecEvent]) -> list[CodecEvent]:
    return [event for event in untimed(events) if isinstance(event, Measurement)]


def noise(driver: StreamDriver, random: Random) -> bytes:
    """Return damage of one kind, without a complete frame."""
    frame = driver.example_frame(random)
    flipped = bytearray(frame)
    flipped[random.randrange(len(frame))] ^= 1 << random.randrange(8)
    head = frame[: random.randint(1, 8)]
    text = random.choice((b"APP_VER=156\r\n", b"OK\n", b"\r", b"Z", b"no end", b"\r\n", b"x" * 400))
    kinds = (
        random.randbytes(random.randint(1, 60)),
        frame[: random.randrange(1, len(frame))],  # truncated
        frame[random.randrange(1, len(frame)) :],  # start lost
        bytes(flipped),
        head + random.randbytes(random.randint(0, 6)),  # a wrong length
        frame[:2] * random.randint(1, 5) + head,  # adjacent sync words
        text,
    )
    return random.choice(kinds)


@every_driver_and_seed
def test_adjacent_frames_are_all_decoded(name: str, seed: int) -> None:
    driver, random = DRIVERS[name], Random(seed)
    frames = [driver.example_frame(random) for _ in range(12)]
    alone = [event for frame in frames for event in make(driver).feed(frame)]
    codec = make(driver)
    together = feed_checked(codec, cut(b"".join(frames), random))
    assert (untimed(together), codec.ledger.frames_good) == (untimed(alone), len(frames))
    assert codec.ledger.bytes_in_good_frames == codec.ledger.bytes_in


@every_driver_and_seed
def test_any_split_gives_the_same_events(name: str, seed: int) -> None:
    driver, random = DRIVERS[name], Random(seed)
    stream = b"".join(random.choice((driver.example_frame, lambda r: noise(driver, r)))(random) for _ in range(15))
    whole, single, parts = make(driver), make(driver), make(driver)
    expected = untimed(feed_checked(whole, [stream]))
    assert untimed(feed_checked(single, (stream[i : i + 1] for i in range(len(stream))))) == expected
    assert untimed(feed_checked(parts, cut(stream, random))) == expected
    assert whole.ledger.snapshot() == single.ledger.snapshot() == parts.ledger.snapshot()


@every_driver_and_seed
def test_a_cut_frame_costs_only_itself(name: str, seed: int) -> None:
    driver, random = DRIVERS[name], Random(seed)
    before, after, lost = ([driver.example_frame(random) for _ in range(n)] for n in (3, 8, 1))
    shortened = lost[0][: random.randrange(1, len(lost[0]))]
    events = feed_checked(make(driver), cut(b"".join([*before, shortened, *after]) + bytes(IDLE), random))
    expected = [event for frame in before + after for event in make(driver).feed(frame)]
    assert measurements(events) == measurements(expected)


@every_driver_and_seed
def test_noise_never_costs_an_intact_frame(name: str, seed: int) -> None:
    driver, random = DRIVERS[name], Random(seed)
    stream, expected = b"", list[CodecEvent]()
    for _ in range(12):
        frame = driver.example_frame(random)
        stream += b"".join(noise(driver, random) for _ in range(random.randrange(3))) + frame
        expected += make(driver).feed(frame)
    found = measurements(feed_checked(make(driver), cut(stream + bytes(IDLE), random)))
    assert contains_in_order(found, measurements(expected))


def contains_in_order(found: Sequence[CodecEvent], wanted: Sequence[CodecEvent]) -> bool:
    rest = iter(found)
    return all(any(event == other for other in rest) for event in wanted)


@every_driver
@given(data=st.binary(max_size=600), seed=st.integers(0, 2**32))
def test_random_bytes_never_raise(name: str, data: bytes, seed: int) -> None:
    driver, random = DRIVERS[name], Random(seed)
    sync = driver.example_frame(random)[:2]
    codec = make(driver)
    feed_checked(codec, cut(data + sync + data.replace(b"\x00", sync), random))
    codec.flush()
    assert codec.ledger.closes()


@every_driver_and_seed
def test_flush_returns_frames_inside_an_incomplete_frame(name: str, seed: int) -> None:
    """A header with a too large length hides the following frames until the link is idle."""
    driver, random = DRIVERS[name], Random(seed)
    frames = [driver.example_frame(random) for _ in range(3)]
    expected = [event for frame in frames for event in make(driver).feed(frame)]
    for length in range(2, 8):
        codec = make(driver)
        cut_short = frames[0][:length]
        events = feed_checked(codec, cut(cut_short + b"".join(frames), random))
        events += codec.flush()
        assert measurements(events) == measurements(expected)
        assert codec.ledger.closes()


@every_driver_and_seed
def test_flush_keeps_and_reset_skips_pending_bytes(name: str, seed: int) -> None:
    """A frame with a pause in its middle still arrives, even if the link counts as idle several times."""
    driver, random = DRIVERS[name], Random(seed)
    frame = driver.example_frame(random)
    expected = untimed(make(driver).feed(frame))
    codec = make(driver)
    events: list[CodecEvent] = []
    for part in cut(frame, random):
        events += codec.feed(part)
        events += codec.flush()
        assert codec.ledger.closes()
    assert untimed(events) == expected
    codec = make(driver)
    part = random.choice((frame[: random.randrange(1, len(frame))], b"half a line", b"Z"))
    codec.feed(part)
    codec.reset()
    assert (codec.ledger.bytes_pending, codec.ledger.bytes_skipped) == (0, len(part))
    assert codec.ledger.closes()
    assert untimed(codec.feed(frame)) == expected
    assert codec.ledger.closes()


def test_text_interrupted_by_frames_is_one_line() -> None:
    driver, random = DRIVERS["hipnuc-uart"], Random(1)
    codec = make(driver)
    frame = driver.example_frame(random)
    events = feed_checked(codec, [b"APP_VER", frame, b"=15", frame + frame + b"6", b"\r", frame, b"\nOK\n"])
    assert [event.text for event in events if isinstance(event, TextLine)] == ["APP_VER=156", "OK"]
    assert codec.ledger.frames_good == 4 + 2
    assert codec.ledger.bytes_pending == codec.ledger.bytes_skipped == 0


@every_driver
def test_damage_is_counted_by_its_kind(name: str) -> None:
    """A wrong bit in the payload is a CRC error, a length without a frame type is a length error."""
    driver = DRIVERS[name]
    frame = driver.example_frame(Random(1))
    length_at = {"hipnuc-uart": 2, "imu61x-uart": 4}[name]
    wrong_length = frame[:length_at] + b"\xff\xff" + frame[length_at + 2 :]
    for data, reason in ((frame[:-1] + bytes([frame[-1] ^ 1]), BadReason.CRC), (wrong_length, BadReason.LENGTH)):
        codec = make(driver)
        bad = [event for event in feed_checked(codec, [data + bytes(IDLE)]) if isinstance(event, BadFrame)]
        assert [event.reason for event in bad] == [reason]
        counts = codec.ledger.frames_bad_crc, codec.ledger.frames_bad_length, codec.ledger.frames_good
        assert counts == ((1, 0, 0) if reason is BadReason.CRC else (0, 1, 0))
