"""Detection of driver and baud rate for several device families on one port."""

from dataclasses import replace
from random import Random

import pytest

from imud.contracts.driver import StreamDriver
from imud.device.search import GaveUp
from imud.device.stream_search import Search, StreamFound
from imud.drivers.hipnuc.uart.driver import DRIVER as HIPNUC
from imud.drivers.imu61x.uart.codec import Status, encode_acknowledgement, encode_status
from imud.drivers.imu61x.uart.commands import ask_status
from imud.drivers.imu61x.uart.driver import DRIVER as IMU61X
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.support.uart_wire import FakeDevice, run_search

ASK_TRIES = 2

FAMILIES = [HIPNUC, IMU61X]
STATUS = encode_status(Status(10203, 2, 614, (1, 2, 3), 0, 0, 0, 0, 0, 0, 0, bytes(32)))
ANSWERS = {
    "hipnuc-uart": (b"LOG VERSION\r\n", b"PNAME=HI14R3\r\nAPP_VER=156\r\nOK\r\n"),
    "imu61x-uart": (ask_status().payload, STATUS),
}
every_rate = pytest.mark.parametrize(
    ("driver", "baud"), [(driver, baud) for driver in FAMILIES for baud in driver.baud_rates],
    ids=lambda value: value.name if isinstance(value, StreamDriver) else None,
)  # fmt: skip


def device(driver: StreamDriver, baud: int, rate_hz: float, phase_ns: int = 0) -> FakeDevice:
    query, reply = ANSWERS[driver.name]
    return FakeDevice(driver, baud, rate_hz, phase_ns, reply=reply, query=query, random=Random(baud + phase_ns))


@every_rate
@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("hold_ms", [0, 16])
def test_a_streaming_device_is_found_without_a_remembered_rate(
    driver: StreamDriver, baud: int, order: int, hold_ms: int
) -> None:
    random = Random(f"{driver.name} {baud}")
    for _ in range(3):
        far = replace(device(driver, baud, 100, random.randrange(NS_PER_S)), poll_ns=max(hold_ms, 1) * NS_PER_MS)
        search = Search(FAMILIES[::order], may_ask=True, hold_ns=hold_ms * NS_PER_MS)
        found, took_ns, _ = run_search(search, far, start_ns=5 * NS_PER_S)
        assert isinstance(found, StreamFound), found
        assert (found.driver.name, found.baud) == (driver.name, baud)
        assert took_ns < 2 * NS_PER_S
        assert far.sent_to == []
        ledger = Ledger()
        codec = driver.make_codec(ledger, driver.settings())
        for data, _ in found.chunks:  # the codec of the device receives complete frames
            codec.feed(data)
        assert ledger.frames_in_samples >= 2


@every_rate
def test_a_remembered_device_is_found_immediately(driver: StreamDriver, baud: int) -> None:
    search = Search(FAMILIES, remembered=(driver.name, baud))
    found, took_ns, listens = run_search(search, device(driver, baud, 100, 1_234_567), start_ns=NS_PER_S)
    assert isinstance(found, StreamFound)
    assert found.driver is driver
    assert {listen.baud for listen in listens} == {baud}
    assert found.wasted_bytes == 0
    assert took_ns < (0.3 if baud > 9600 else 0.4) * NS_PER_S  # two frames of 136 bytes take 283 ms at 9600 baud


@pytest.mark.parametrize(("before", "now"), [(HIPNUC, IMU61X), (IMU61X, HIPNUC)])
def test_a_replaced_device_of_another_family_is_found(before: StreamDriver, now: StreamDriver) -> None:
    """Another device at the same rate: the search starts at the remembered rate with both codecs."""
    search = Search(FAMILIES, remembered=(before.name, 115200))
    found, took_ns, _ = run_search(search, device(now, 115200, 100, 4_000_000), start_ns=NS_PER_S)
    assert isinstance(found, StreamFound)
    assert found.driver is now
    assert took_ns < 0.3 * NS_PER_S


@every_rate
def test_a_silent_device_is_found_by_its_reply(driver: StreamDriver, baud: int) -> None:
    far = device(driver, baud, 0)
    found, took_ns, _ = run_search(Search(FAMILIES, may_ask=True), far, start_ns=NS_PER_S)
    assert isinstance(found, StreamFound)
    assert (found.driver.name, found.baud) == (driver.name, baud)
    assert took_ns < 8 * NS_PER_S


def test_each_driver_is_queried_equally_often() -> None:
    far = device(HIPNUC, 57600, 0)
    result, _, _ = run_search(Search(FAMILIES, may_ask=True), far)
    assert isinstance(result, GaveUp)
    assert "no reply to a query" in result.summary
    bauds = {baud for driver in FAMILIES for baud in driver.baud_rates}
    for query, _ in ANSWERS.values():
        asked = [baud for baud, sent in far.sent_to if sent == query]
        assert set(asked) == bauds
        assert len(asked) == len(bauds) * ASK_TRIES


def test_an_acknowledgement_is_not_a_reply() -> None:
    far = replace(device(IMU61X, 115200, 0), reply=encode_acknowledgement(1))
    result, _, _ = run_search(Search(FAMILIES, may_ask=True), far, start_ns=NS_PER_S)
    assert isinstance(result, GaveUp)
