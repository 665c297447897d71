"""Detection in virtual time, with a model of the bits at a wrong baud rate.
Detection of driver and baud rate for several device families on one port."""

from dataclasses import replace
from random import Random

import pytest

from imud.contracts.codec import CodecEvent
from imud.contracts.driver import StreamDriver
from imud.device.search import GaveUp, Listen
from imud.device.stream_search import Search, Step, StreamFound
from imud.drivers.hipnuc.uart.driver import DRIVER as HIPNUC
from imud.drivers.imu61x.uart.codec import Status, encode_acknowledgement, encode_status
from imud.drivers.imu61x.uart.commands import ask_status
from imud.drivers.imu61x.uart.driver import DRIVER as IMU61X
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.support.fake_drivers import BAUD_RATES, FAKE_DRIVER, QUERY, REPLY, SYNC, fake_frame
from tests.support.uart_wire import FakeDevice, received, run_search

QUIET_NS = 1200 * 10**6


def device(baud: int, rate_hz: float, phase_ns: int = 0, poll_ns: int = NS_PER_MS) -> FakeDevice:
    return FakeDevice(FAKE_DRIVER, baud, rate_hz, phase_ns, poll_ns, REPLY, QUERY, random=Random(baud + phase_ns))


def found_by(search: Search, far: FakeDevice, start_ns: int = NS_PER_S) -> tuple[StreamFound, int, list[Listen]]:
    """Return the found device, the time of the search, and its visits."""
    found, took_ns, listens = run_search(search, far, start_ns=start_ns)
    assert isinstance(found, StreamFound), found
    return found, took_ns, listens


def given_up(search: Search, far: FakeDevice) -> tuple[GaveUp, int, list[Listen]]:
    result, took_ns, listens = run_search(search, far)
    assert isinstance(result, GaveUp), result
    return result, took_ns, listens


def first_visit(search: Search) -> Listen:
    step = search.start(0)
    assert isinstance(step, Listen)
    return step


def test_the_line_model_changes_bytes_at_a_wrong_rate() -> None:
    data = bytes(range(256))
    assert bytes(value for _, value in received(data, 115200, 115200)) == data
    # 0x00 at 9600 baud: low for nine bits = 108 bits at 115200 baud, with one start edge
    assert [value for _, value in received(b"\x00", 9600, 115200)] == [0]
    # 0x55 at half the rate: start bit low for 2 bits, then 11 00 11 00, sampled 0 11 00 11 0
    assert received(b"\x55", 115200, 230400)[0][1] == 0b01100110


def test_a_wrong_remembered_rate_costs_little_time_and_a_latency_timer_extends_the_visits() -> None:
    search = Search([FAKE_DRIVER], remembered=("fake-uart", 9600))
    found, took_ns, listens = found_by(search, device(921600, 100, 777))
    assert (found.baud, listens[0].baud) == (921600, 9600)
    assert found.wasted_bytes > 0
    assert took_ns < 0.8 * NS_PER_S  # invalid bytes end the long wait
    assert first_visit(Search([FAKE_DRIVER], remembered=("gone-uart", 9600))).baud == BAUD_RATES[0]
    assert first_visit(Search([FAKE_DRIVER], remembered=("fake-uart", 57600))).baud == BAUD_RATES[0]
    assert first_visit(Search([FAKE_DRIVER], bauds=(9600,), remembered=("fake-uart", 115200))).baud == 9600
    first, longer = (first_visit(Search([FAKE_DRIVER], hold_ns=hold_ns)).until_ns for hold_ns in (0, 16 * NS_PER_MS))
    assert longer - first == 16 * NS_PER_MS


@pytest.mark.parametrize(("baud", "rate_hz"), [(9600, 1.0), (115200, 1.0), (921600, 1.0), (230400, 5.0), (256000, 20)])
def test_a_slow_device_is_found_in_a_later_pass(baud: int, rate_hz: float) -> None:
    for phase_ns in range(0, NS_PER_S, NS_PER_S // 7):
        far = device(baud, rate_hz, phase_ns)
        found, took_ns, _ = found_by(Search([FAKE_DRIVER], may_ask=True), far, 9 * NS_PER_S)
        assert found.baud == baud
        assert took_ns < 15 * NS_PER_S
        assert far.sent_to == []


@pytest.mark.parametrize("baud", BAUD_RATES)
def test_a_silent_device_is_queried_only_after_the_quiet_time(baud: int) -> None:
    far = device(baud, 0)
    found, took_ns, listens = found_by(Search([FAKE_DRIVER], may_ask=True), far)
    assert found.baud == baud
    first_question = next(index for index, listen in enumerate(listens) if listen.send)
    assert listens[first_question - 1].until_ns - NS_PER_S >= QUIET_NS
    assert took_ns < 4 * NS_PER_S
    assert b"".join(data for data, _ in found.chunks) == REPLY


def test_no_query_without_permission_or_to_another_device_or_into_noise() -> None:
    far = device(115200, 0)
    result, _, listens = given_up(Search([FAKE_DRIVER]), far)
    assert (far.sent_to, {listen.baud for listen in listens}) == ([], set(BAUD_RATES))
    assert "got no byte at 115200" in result.summary
    assert "query" not in result.summary
    far = replace(device(115200, 10), noise=b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n")
    result, _, _ = given_up(Search([FAKE_DRIVER], may_ask=True), far)
    assert far.sent_to == []
    assert "115200: " in result.summary
    assert "0 valid frames" in result.summary
    assert result.wasted_bytes > 0
    far = replace(device(115200, 0), reply=b"OK\r\n")
    given_up(Search([FAKE_DRIVER], may_ask=True), far)
    random = Random(7)
    for noise in (fake_frame(b"x" * 76)[:60], fake_frame(b"x" * 76)[:60] + SYNC, random.randbytes(82), SYNC * 40):
        far = replace(device(115200, 100, 3_000_000), noise=noise)
        given_up(Search([FAKE_DRIVER], may_ask=True), far)
        assert far.sent_to == []
    search = Search([FAKE_DRIVER], may_ask=True)
    step: Step | None = search.start(0)
    now_ns = 0
    while isinstance(step, Listen) and not step.send:
        now_ns = step.until_ns
        step = search.on_time(now_ns)
    assert isinstance(step, Listen)
    assert step.send == QUERY
    sent = 0
    step = search.on_data(b"\xff", now_ns + 1) or step
    while isinstance(step, Listen):
        now_ns = step.until_ns
        step = search.on_time(now_ns)
        sent += isinstance(step, Listen) and bool(step.send)
    assert isinstance(step, GaveUp)
    assert sent == 0


def test_two_good_frames_are_enough_with_few_bad_frames_and_noise() -> None:
    search = Search([FAKE_DRIVER], bauds=(115200,))
    search.start(0)
    step = search.on_data(fake_frame(b"x" * 76), 1)
    assert isinstance(step, Listen)  # a longer visit
    assert step.until_ns > NS_PER_S
    assert isinstance(search.on_data(fake_frame(b"y" * 76), 2), StreamFound)
    bad = fake_frame(b"x" * 76)[:-1] + b"y"
    good = fake_frame(b"z" * 76)
    search = Search([FAKE_DRIVER], bauds=(115200,))
    search.start(0)
    for place, frame in enumerate([bad, bad, good, good, bad, bad, bad, good]):
        assert not isinstance(search.on_data(frame, place), StreamFound)
    assert isinstance(search.on_data(good, 9), StreamFound)
    far = replace(device(460800, 100, 4_000_000), damage=0.4)
    _, took_ns, _ = found_by(Search([FAKE_DRIVER]), far)
    assert took_ns < 2 * NS_PER_S
    search = Search([FAKE_DRIVER], bauds=(115200,))
    step = first_visit(search)
    lie = b"\x5a\xa5\x00\x02\x00\x00"  # its length field is 512
    assert search.on_data(lie + fake_frame(b"a" * 76) + fake_frame(b"b" * 76), 1) is None
    assert isinstance(search.on_time(step.until_ns), StreamFound)
    search = Search([FAKE_DRIVER], bauds=(115200,))
    step = first_visit(search)
    assert search.on_data(lie + fake_frame(b"a" * 76), 1) is None
    longer = search.on_time(step.until_ns)  # one valid frame inside the damaged one
    assert longer == replace(step, until_ns=2 * step.until_ns)


def test_each_byte_is_in_the_result_or_counted_as_wasted() -> None:
    far = device(9600, 100, 5_000_000)
    search = Search([FAKE_DRIVER])
    heard = 0
    take = search.on_data

    def counting(data: bytes, t_rx_ns: int) -> object:
        nonlocal heard
        heard += len(data)
        return take(data, t_rx_ns)

    search.on_data = counting  # type: ignore[method-assign, assignment]  # a spy
    found, _, _ = found_by(search, far)
    assert found.wasted_bytes > 0
    assert sum(len(data) for data, _ in found.chunks) + found.wasted_bytes == heard


def test_an_unsupported_rate_is_skipped_and_a_visit_ends_at_its_limit() -> None:
    search = Search([FAKE_DRIVER], bauds=(921600, 9600))
    step: Step | None = search.start(0)
    now_ns = 0
    seen: list[int] = []
    while isinstance(step, Listen):
        seen.append(step.baud)
        now_ns = step.until_ns
        if step.baud == 921600:
            step = search.refused("the port cannot do it", now_ns)
        else:
            search.on_data(b"\x01", now_ns - 1)
            step = search.on_time(now_ns)
    assert isinstance(step, GaveUp)
    assert seen.count(921600) == 1
    assert "921600: the port cannot do it" in step.summary
    search = Search([FAKE_DRIVER], may_ask=True)
    step = search.start(0)
    for number in range(len(BAUD_RATES)):
        assert isinstance(step, Listen)
        step = search.refused("not to be had", number)
    assert isinstance(step, GaveUp)
    assert "9600: not to be had" in step.summary
    search = Search([FAKE_DRIVER])
    visit = first_visit(search)
    assert search.on_time(visit.until_ns - 1) is None
    changes = [search.on_data(bytes(4096), number) for number in range(65)]
    assert changes[:-1] == [None] * 64, "256 KiB are within the limit"
    assert isinstance(changes[-1], Listen)
    assert changes[-1].baud != visit.baud


def test_the_frames_determine_one_of_the_drivers() -> None:
    other = replace(FAKE_DRIVER, name="other-uart", make_codec=lambda ledger, options: DeafCodec(ledger))
    for drivers in ([other, FAKE_DRIVER], [FAKE_DRIVER, other]):
        found, _, _ = found_by(Search(drivers), device(115200, 100))
        assert found.driver is FAKE_DRIVER
    with pytest.raises(ValueError, match="at least one driver"):
        Search([])


class DeafCodec:
    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self.unknown: dict[int, int] = {}

    def feed(self, data: bytes) -> list[CodecEvent]:
        return []

    def flush(self) -> list[CodecEvent]:
        return []

    def reset(self) -> None: ...


def test_a_reply_behind_other_frames_and_frames_of_several_visits_count() -> None:
    search = Search([FAKE_DRIVER], bauds=(115200,), may_ask=True)
    step: Step | None = search.start(0)
    while isinstance(step, Listen) and not step.send:
        step = search.on_time(step.until_ns)
    assert isinstance(step, Listen)
    found = search.on_data(fake_frame(b"x" * 76) + REPLY, step.until_ns - 1)  # one frame is not enough
    assert isinstance(found, StreamFound)
    deaf = replace(FAKE_DRIVER, name="other-uart", make_codec=lambda ledger, options: DeafCodec(ledger))
    search = Search([deaf, FAKE_DRIVER], bauds=(115200, 9600))
    step, visits = search.start(0), 0
    while isinstance(step, Listen):
        if step.baud == 9600:
            visits += 1
            frame = fake_frame(b"x" * 76)
            step = search.on_data(frame + frame[:-1] + b"y", step.until_ns - 1) or step
        step = search.on_time(step.until_ns) if isinstance(step, Listen) else step
    assert isinstance(step, GaveUp)
    assert visits > 1
    assert f"9600: {visits * 164} bytes, {visits} valid frames, {visits} damaged" in step.summary


@pytest.mark.parametrize("bauds", [(115200,), BAUD_RATES])
def test_only_received_bytes_make_longer_visits_of_several_rates(bauds: tuple[int, ...]) -> None:
    """Foreign bytes: three passes with longer visits, one rate: one visit. No bytes: only the quiet time."""
    foreign = replace(device(115200, 10), noise=b"$GPGGA,123519,4807.038,N,01131.000,E*47\r\n")
    _, _, listens = given_up(Search([FAKE_DRIVER], bauds=bauds), foreign)
    assert [listen.baud for listen in listens] == [*bauds] * (3 if len(bauds) > 1 else 1)
    _, took_ns, _ = run_search(Search([FAKE_DRIVER], bauds=bauds), device(115200, 0))
    assert QUIET_NS <= took_ns < QUIET_NS + 100 * NS_PER_MS


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


def family_device(driver: StreamDriver, baud: int, rate_hz: float, phase_ns: int = 0) -> FakeDevice:
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
        far = replace(family_device(driver, baud, 100, random.randrange(NS_PER_S)), poll_ns=max(hold_ms, 1) * NS_PER_MS)
        search = Search(FAMILIES[::order], may_ask=True, hold_ns=hold_ms * NS_PER_MS)
        found, took_ns, _ = found_by(search, far, 5 * NS_PER_S)
        assert (found.driver.name, found.baud) == (driver.name, baud)
        assert took_ns < 2 * NS_PER_S
        assert far.sent_to == []
        ledger = Ledger()
        codec = driver.make_codec(ledger, driver.settings())
        for data, _ in found.chunks:  # the codec of the device receives complete frames
            codec.feed(data)
        assert ledger.frames_in_samples >= 2


@every_rate
def test_a_remembered_device_is_found_immediately_and_a_silent_device_by_its_reply(
    driver: StreamDriver, baud: int
) -> None:
    search = Search(FAMILIES, remembered=(driver.name, baud))
    found, took_ns, listens = found_by(search, family_device(driver, baud, 100, 1_234_567))
    assert found.driver is driver
    assert ({listen.baud for listen in listens}, found.wasted_bytes) == ({baud}, 0)
    assert took_ns < (0.3 if baud > 9600 else 0.4) * NS_PER_S  # two frames of 136 bytes take 283 ms at 9600 baud
    far = family_device(driver, baud, 0)
    found, took_ns, _ = found_by(Search(FAMILIES, may_ask=True), far)
    assert (found.driver.name, found.baud) == (driver.name, baud)
    assert took_ns < 8 * NS_PER_S


@pytest.mark.parametrize(("before", "now"), [(HIPNUC, IMU61X), (IMU61X, HIPNUC)])
def test_a_replaced_device_of_another_family_is_found(before: StreamDriver, now: StreamDriver) -> None:
    """Another device at the same rate: the search starts at the remembered rate with both codecs."""
    search = Search(FAMILIES, remembered=(before.name, 115200))
    found, took_ns, _ = found_by(search, family_device(now, 115200, 100, 4_000_000))
    assert found.driver is now
    assert took_ns < 0.3 * NS_PER_S


def test_each_driver_is_queried_equally_often_and_an_acknowledgement_is_no_reply() -> None:
    far = family_device(HIPNUC, 57600, 0)
    result, _, _ = given_up(Search(FAMILIES, may_ask=True), far)
    assert "no reply to a query" in result.summary
    bauds = {baud for driver in FAMILIES for baud in driver.baud_rates}
    for query, _ in ANSWERS.values():
        asked = [baud for baud, sent in far.sent_to if sent == query]
        assert (set(asked), len(asked)) == (bauds, len(bauds) * ASK_TRIES)
    far = replace(family_device(IMU61X, 115200, 0), reply=encode_acknowledgement(1))
    given_up(Search(FAMILIES, may_ask=True), far)
