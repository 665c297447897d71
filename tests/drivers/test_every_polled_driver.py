"""Every polled driver, from its row in DRIVERS: damage is reported, no exception is raised, ledgers balance."""

from collections.abc import Callable
from contextlib import suppress
from random import Random

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.contracts.codec import PolledCodec, Vanished
from imud.contracts.driver import PolledDriver, of_kind
from imud.contracts.script import Transfer, run_transfer_script
from imud.drivers import DRIVERS
from imud.links import LINKS
from imud.model.errors import DeviceRefused, TransferError, Trouble
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from tests.support.codec_invariants import decode_polled

NAMES = [driver.name for driver in of_kind(DRIVERS.values(), PolledDriver)]
TRANSFERS_MAX = 20  # maximum number of transfers of any script, for any replies

every_driver = pytest.mark.parametrize("name", NAMES)


def every_driver_and_seed(test: Callable[[str, int], None]) -> Callable[..., None]:
    seeded: Callable[..., None] = every_driver(given(seed=st.integers(0, 2**32))(test))
    return seeded


def row(name: str) -> PolledDriver:
    driver = DRIVERS[name]
    assert isinstance(driver, PolledDriver)
    return driver


def make(driver: PolledDriver) -> PolledCodec:
    return driver.make_codec(Ledger(), driver.settings())


@every_driver_and_seed
def test_good_frames_make_one_measurement_each(name: str, seed: int) -> None:
    driver, random = row(name), Random(seed)
    codec = make(driver)
    for number in range(1, 6):
        (event,) = decode_polled(codec, 0, driver.example_reading(random))
        assert isinstance(event, Measurement)
        assert event.size_bytes * number == codec.ledger.bytes_in_good_frames
    assert codec.ledger.frames_in_samples == codec.ledger.frames_good == 5
    codec = make(driver)
    data = driver.example_reading(Random(seed))
    decode_polled(codec, 0, data)
    assert decode_polled(codec, 0, data) == ()
    assert codec.stale == codec.ledger.frames_ignored == 1
    codec.reset()
    assert len(decode_polled(codec, 0, data)) == 1
    silent = [event for poll in range(len(codec.polls)) for event in codec.on_silence(poll)]
    assert not any(isinstance(event, Measurement) for event in silent)


@every_driver_and_seed
def test_damage_never_passes_silently(name: str, seed: int) -> None:
    """One wrong bit, one wrong byte, or a run of them: the same measurement, or no measurement and an event."""
    driver, random = row(name), Random(seed)
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


@every_driver
@given(data=st.binary(max_size=120), poll=st.integers(0, 2), repeat=st.booleans())
def test_any_bytes_of_any_length_raise_nothing(name: str, data: bytes, poll: int, repeat: bool) -> None:
    codec = make(row(name))
    poll %= len(codec.polls)
    decode_polled(codec, poll, data)
    decode_polled(codec, poll, data * 2 if repeat else data)
    codec.reset()
    assert codec.ledger.closes()


@every_driver
@pytest.mark.parametrize("line", [0x00, 0xFF])
def test_a_bus_without_a_device_reports_vanished(name: str, line: int) -> None:
    driver = row(name)
    codec = make(driver)
    data = bytes([line]) * len(driver.example_reading(Random(1)))
    (event,) = decode_polled(codec, 0, data)
    assert isinstance(event, Vanished)
    assert f"0x{line:02X}" in event.why
    assert codec.ledger.frames_bad() == 0


@every_driver_and_seed
def test_scripts_end_after_any_replies(name: str, seed: int) -> None:
    """Scripts return after noise and failures in any order, or raise a permitted error."""
    driver, random = row(name), Random(seed)
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


@every_driver
@pytest.mark.manual("A 3.1 address")
def test_targets_and_link_of_the_row_and_an_address_outside_the_targets(name: str) -> None:
    driver = row(name)
    assert len(set(driver.targets)) == len(driver.targets) > 0
    assert LINKS[driver.link].polled
    assert LINKS[driver.link].fits(driver)
    assert [link for link in LINKS if LINKS[link].fits(driver)] == [driver.link]
    intervals_s = {"imu61x-i2c": [0, 10, 10], "imu61x-spi": [0, 10, 1], "hipnuc-modbus": [0, 10, 1, 10]}[name]
    assert [poll.every_ns for poll in make(driver).polls] == [interval_s * 10**9 for interval_s in intervals_s]
    assert driver.update_ns(driver.settings()) == 0  # not known
    assert driver.update_ns(msgspec.convert({"update_hz": 200}, driver.settings)) == 5_000_000
    assert msgspec.structs.fields(driver.settings)
    driver = row(name)
    addresses = (driver.targets[0], driver.targets[-1], "auto", 0x77)
    links = [object(), *(type("Link", (), {"address": address})() for address in addresses)]
    expected = [0, 0, 0, 0, int(name.startswith("imu61x"))]  # 0x77 is a valid address of Modbus
    found = [list(driver.problems(driver.settings(), link)) for link in links]
    assert [len(problems) for problems in found] == expected
    assert all("got 0x77" in problem.message for problem in found[-1])


READ_NS: list[tuple[str, object, object, int]] = [
    # 16 words of 16 bits at 1 µs: the burst command, two cycles of the pipeline and 13 values
    ("imu61x-spi", {}, {"port": "x", "speed_hz": 1_000_000}, 256_000),
    ("imu61x-spi", {}, {"port": "x", "speed_hz": 2_000_000}, 128_000),
    # 35 bytes of 9 bits at 400 kHz (two addresses, the register, 32 bytes of data), start, repeated start and stop
    ("imu61x-i2c", {}, {}, (35 * 9 + 3) * 2_500),
]


def test_the_time_of_a_read_on_the_bus() -> None:
    for name, options, link, expected_ns in READ_NS:
        driver = row(name)
        made = msgspec.convert(options, driver.settings), msgspec.convert(link, LINKS[driver.link].settings)
        assert driver.read_ns(*made) == expected_ns
