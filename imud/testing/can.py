"""Requirements for every CAN driver: foreign, missing, repeated and random frames."""

from collections.abc import Iterable, Sequence
from random import Random
from typing import Final

from imud.contracts.codec import CanCodec, CodecEvent
from imud.contracts.driver import CanDriver
from imud.formats.can import EXTENDED_ID_MAX, FD_LENGTHS, STANDARD_ID_MAX, CanFrame, pack_frame
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.testing.invariants import feed_frames, finite

PERIOD_NS: Final = 10_000_000
FRAME_NS: Final = 250_000
LEARNING_SETS: Final = 10  # some devices' samples depend on earlier frames


def make(driver: CanDriver) -> CanCodec:
    """Return a codec that has learned the device, with a new ledger."""
    codec = driver.make_codec(Ledger(), driver.settings())
    for frame in (frame for number in range(LEARNING_SETS) for frame in timed(driver, Random(number), number)):
        codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.t_rx_ns)
    assert codec.problem == ""
    assert codec.ledger.closes()
    assert codec.ledger.frames_in_samples >= driver.sample_frames
    assert codec.ledger.frames_pending == codec.ledger.frames_bad() == codec.ledger.bytes_skipped == 0
    codec.ledger.__init__()  # type: ignore[misc]  # all counters to zero; the codec keeps its own
    return codec


def timed(driver: CanDriver, random: Random, number: int) -> list[CanFrame]:
    """Return a set at its time: a steady period, with the frames of a set back to back."""
    frames = driver.example_frames(random)
    return [f._replace(t_rx_ns=number * PERIOD_NS + place * FRAME_NS) for place, f in enumerate(frames)]


def is_own(driver: CanDriver, frame: CanFrame) -> bool:
    """Return whether the driver receives a frame with its default options."""
    return any(wanted.matches(frame.can_id, frame.extended) for wanted in driver.filters(driver.settings()))


def foreign(driver: CanDriver, random: Random) -> CanFrame:
    """Return a frame of another device: any other identifier, often an adjacent one."""
    while True:
        extended = random.random() < 0.4
        most = EXTENDED_ID_MAX if extended else STANDARD_ID_MAX
        own = random.choice(driver.example_frames(random)).can_id
        near = (own + random.randint(-8, 8)) % (most + 1)
        can_id = random.choice((random.randrange(most + 1), near, own & most))
        frame = CanFrame(can_id, extended, random.randbytes(random.randint(0, 8)), 0)
        if not is_own(driver, frame):
            return frame


def measurements(events: Iterable[CodecEvent]) -> list[Measurement]:
    """Return the measurements of events."""
    return [event for event in events if isinstance(event, Measurement)]


def sets(driver: CanDriver, random: Random, count: int) -> list[Sequence[CanFrame]]:
    """Return sets of frames after the sets that a codec of `make` has learned."""
    return [timed(driver, random, LEARNING_SETS + number) for number in range(count)]


def makes_incomplete_samples(driver: CanDriver) -> bool:
    """Return whether the first frame of a set alone makes a measurement."""
    codec = driver.make_codec(Ledger(), driver.settings())
    events = codec.feed_frame(*timed(driver, Random(1), 0)[0][:4])
    found = measurements([*events, *codec.flush()])
    assert codec.ledger.closes()
    assert len(found) <= 1
    return bool(found)


def frames_of_a_sample_make_one(driver: CanDriver, random: Random, _data: bytes) -> None:
    """A receiver may get a frame twice if the sender detected an error in its last bits (ISO 11898-1)."""
    groups = sets(driver, random, 8)
    codec = make(driver)
    for group in groups:
        assert len(group) == driver.sample_frames
        assert len(measurements(feed_frames(make(driver), group))) == 1
    events = feed_frames(codec, (frame for group in groups for frame in group))
    assert len(measurements(events)) == len(events) == len(groups)
    assert codec.ledger.frames_in_samples == codec.ledger.frames_good == len(groups) * driver.sample_frames
    assert codec.ledger.bytes_in_good_frames == codec.ledger.bytes_in
    own = [frame for group in sets(driver, random, 6) for frame in group]
    twice = [frame for original in own for frame in [original] * random.choice((1, 1, 2))]
    found = measurements(feed_frames(make(driver), twice))
    assert found == measurements(feed_frames(make(driver), own))


def frames_of_others_change_nothing(driver: CanDriver, random: Random, _data: bytes) -> None:
    own = [frame for group in sets(driver, random, 6) for frame in group]
    expected = feed_frames(make(driver), own)
    mixed: list[CanFrame] = []
    skipped = 0
    for frame in own:
        others = [foreign(driver, random) for _ in range(random.randrange(4))]
        skipped += sum(len(other.data) for other in others)
        mixed += [*others, frame]
    codec = make(driver)
    assert (feed_frames(codec, mixed), codec.ledger.bytes_skipped) == (expected, skipped)


def missing_frames_cost_their_samples_only(driver: CanDriver, random: Random, _data: bytes) -> None:
    """Values are never mixed: each value is from the set at the time of its measurement."""
    groups = sets(driver, random, 12)
    whole = [measurements(feed_frames(make(driver), group))[0] for group in groups]
    heard: list[CanFrame] = []
    intact: list[Measurement] = []
    for group, expected in zip(groups, whole, strict=True):
        lost = {random.randrange(len(group))} if random.random() < 0.3 else set()
        heard += [frame for place, frame in enumerate(group) if place not in lost]
        intact += [] if lost else [expected]
    codec = make(driver)
    found = measurements([*feed_frames(codec, heard), *codec.flush()])
    assert [one for one in found if one in intact] == intact
    if driver.sample_frames == 1 or makes_incomplete_samples(driver):
        assert codec.ledger.frames_in_samples == codec.ledger.frames_good == len(heard)
    else:
        assert found == intact
    for one in found:
        assert one.t_first_ns is not None
        expected = whole[one.t_first_ns // PERIOD_NS - LEARNING_SETS]
        assert one.accel_m_s2 in (None, expected.accel_m_s2)
        assert one.gyro_rad_s in (None, expected.gyro_rad_s)


def of_any_type(driver: CanDriver, random: Random) -> CanFrame:
    """Return a frame with an identifier that the driver receives, and random data of any length, CAN FD included."""
    wanted, size = random.choice(driver.filters(driver.settings())), random.choice((8, 8, 8, 64, *FD_LENGTHS))
    return CanFrame(wanted.can_id, wanted.extended, random.randbytes(size), random.randrange(100 * PERIOD_NS))


def any_frames_in_any_order_never_raise(driver: CanDriver, random: Random, _data: bytes) -> None:
    frames: list[CanFrame] = []
    for group in sets(driver, random, 12):
        for frame in group:
            kinds = (
                frame, frame, foreign(driver, random), of_any_type(driver, random),
                frame._replace(data=random.randbytes(len(frame.data))),
                frame._replace(data=random.randbytes(random.randint(0, 8))),
                frame._replace(data=b"\x00\x00\x80\x7f\xff\xff\xff\xff"),  # infinity and NaN as floats
            )  # fmt: skip
            frames += random.choices(kinds, k=random.choice((0, 1, 1, 1, 3)))
    random.shuffle(frames)
    codec = make(driver)
    events = feed_frames(codec, frames)
    codec.reset()
    assert codec.ledger.frames_pending == codec.ledger.bytes_pending == 0
    assert codec.ledger.closes()
    partial = "NaN" in driver.euler_convention  # some devices send one angle without the others
    assert all(finite(event, partial) for event in measurements(events))


def reset_separates_bytes_before_and_after(driver: CanDriver, random: Random, _data: bytes) -> None:
    before, after = sets(driver, random, 2)
    cut = random.randrange(len(before))
    codec = make(driver)
    feed_frames(codec, before[:cut])
    codec.reset()
    assert codec.ledger.frames_pending == 0
    assert codec.ledger.closes()
    events = [
        event for frame in after for event in codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.t_rx_ns)
    ]
    assert events == feed_frames(make(driver), after)


def filters_pass_the_frames_which_name_their_node(driver: CanDriver, _random: Random, _data: bytes) -> None:
    """Detection makes the driver options from the node of a frame. These options accept all frames of the device."""
    frames = driver.example_frames(Random(1))
    nodes = {driver.node_of(frame.can_id, frame.extended, frame.data) for frame in frames} - {None}
    (node,) = nodes
    assert node is not None
    assert str(node) in driver.node_title(node)
    filters = driver.filters(driver.node_settings(node))
    sent = driver.sent_by(driver.node_settings(node))
    assert all(any(one.matches(frame.can_id, frame.extended) for one in sent) for frame in frames)
    for frame in frames:
        assert any(wanted.matches(frame.can_id, frame.extended) for wanted in filters)
        assert driver.node_of(frame.can_id, not frame.extended, frame.data) is None
        if driver.node_of(frame.can_id, frame.extended, frame.data) is not None:
            assert driver.node_of(frame.can_id, frame.extended, b"") is None
    filters = driver.filters(driver.settings())
    assert all(pack_frame(wanted.can_id, wanted.extended, b"") for wanted in filters)
    assert all(is_own(driver, frame) for frame in driver.example_frames(Random(1)))


REQUIREMENTS: Final = (
    frames_of_a_sample_make_one,
    frames_of_others_change_nothing,
    missing_frames_cost_their_samples_only,
    any_frames_in_any_order_never_raise,
    reset_separates_bytes_before_and_after,
    filters_pass_the_frames_which_name_their_node,
)
