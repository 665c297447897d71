"""Requirements for every polled driver: damage is reported, no exception is raised, ledgers balance."""

from contextlib import suppress
from random import Random
from typing import Final

from imud.contracts.codec import PolledCodec, Vanished
from imud.contracts.driver import PolledDriver
from imud.contracts.script import Transfer, run_transfer_script
from imud.links import LINKS
from imud.model.errors import DeviceRefused, TransferError, Trouble
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.testing.invariants import decode_polled

TRANSFERS_MAX: Final = 20  # maximum number of transfers of any script, for any replies


def make(driver: PolledDriver) -> PolledCodec:
    """Return a codec with its own ledger and default options."""
    return driver.make_codec(Ledger(), driver.settings())


def good_frames_make_one_measurement_each(driver: PolledDriver, random: Random, _data: bytes) -> None:
    codec = make(driver)
    for number in range(1, 6):
        (event,) = decode_polled(codec, 0, driver.example_reading(random))
        assert isinstance(event, Measurement)
        assert event.size_bytes * number == codec.ledger.bytes_in_good_frames
    assert codec.ledger.frames_in_samples == codec.ledger.frames_good == 5
    codec = make(driver)
    data = driver.example_reading(random)
    decode_polled(codec, 0, data)
    assert decode_polled(codec, 0, data) == ()
    assert codec.stale == codec.ledger.frames_ignored == 1
    codec.reset()
    assert len(decode_polled(codec, 0, data)) == 1
    silent = [event for poll in range(len(codec.polls)) for event in codec.on_silence(poll)]
    assert not any(isinstance(event, Measurement) for event in silent)


def damage_never_passes_silently(driver: PolledDriver, random: Random, _data: bytes) -> None:
    """One wrong bit, one wrong byte, or a run of them: the same measurement, or no measurement and an event."""
    data = driver.example_reading(random)
    (good,) = make(driver).decode(0, data)
    damaged = bytearray(data)
    at = random.randrange(len(data))
    match random.randrange(3):
        case 0:
            damaged[at] ^= 1 << random.randrange(8)
        case 1:
            damaged[at] = random.randrange(256)
        case _:
            damaged[at:] = bytes([random.choice((0x00, 0xFF))]) * (len(data) - at)
    events = decode_polled(make(driver), 0, bytes(damaged))
    assert events
    assert events == (good,) or not any(isinstance(event, Measurement) for event in events)


def any_bytes_of_any_length_raise_nothing(driver: PolledDriver, random: Random, data: bytes) -> None:
    codec = make(driver)
    poll = random.randrange(len(codec.polls))
    decode_polled(codec, poll, data)
    decode_polled(codec, poll, data * random.choice((1, 2)))
    codec.reset()
    assert codec.ledger.closes()


def a_bus_without_a_device_reports_vanished(driver: PolledDriver, random: Random, _data: bytes) -> None:
    for line in (0x00, 0xFF):
        codec = make(driver)
        data = bytes([line]) * len(driver.example_reading(random))
        (event,) = decode_polled(codec, 0, data)
        assert isinstance(event, Vanished)
        assert f"0x{line:02X}" in event.why
        assert codec.ledger.frames_bad() == 0


def scripts_end_after_any_replies(driver: PolledDriver, random: Random, _data: bytes) -> None:
    """Scripts return after noise and failures in any order, or raise a permitted error."""
    transfers = 0

    def transfer(wanted: Transfer) -> bytes:
        nonlocal transfers
        transfers += 1
        assert transfers <= TRANSFERS_MAX
        if random.random() < 0.2:
            raise TransferError(random.choice(list(Trouble)), "by the test")
        size = wanted.read_bytes or sum(map(len, wanted.sends))
        return random.choice((random.randbytes(size), b"\xff" * size, bytes(size), b""))

    options = driver.settings()
    for script in (driver.probe(options), driver.set_up(options)):
        transfers = 0
        with suppress(TransferError, DeviceRefused):
            run_transfer_script(script, transfer)


def one_link_fits_and_each_target_occurs_once(driver: PolledDriver, _random: Random, _data: bytes) -> None:
    assert len(set(driver.targets)) == len(driver.targets) > 0
    assert LINKS[driver.link].polled
    assert [link for link in LINKS if LINKS[link].fits(driver)] == [driver.link]


REQUIREMENTS: Final = (
    good_frames_make_one_measurement_each,
    damage_never_passes_silently,
    any_bytes_of_any_length_raise_nothing,
    a_bus_without_a_device_reports_vanished,
    scripts_end_after_any_replies,
    one_link_fits_and_each_target_occurs_once,
)
