"""Detection on a CAN bus: one, several or no devices, unknown, claimed and remembered devices."""

from random import Random

import pytest

from imud.contracts.driver import CanDriver, of_kind
from imud.device.can_search import CanFound, CanSearch, CanStep, CanSurvey
from imud.device.search import GaveUp, Listen
from imud.drivers import DRIVERS as TABLE
from imud.drivers.imu61x.can import DRIVER as IMU61X
from imud.drivers.imu61x.can import encode_set
from imud.formats.can import CanFrame
from imud.model.units import NS_PER_MS, NS_PER_S
from tests.support.fake_drivers import BASE, fake_can_driver, fake_can_frame

DEVICES_MAX = 128
IDENTIFIERS_MAX = 4096
LISTEN_NS = 1500 * NS_PER_MS

FAKE = fake_can_driver()
DRIVERS = (FAKE, IMU61X)


def imu61x(index: int, base_id: int = 101) -> list[CanFrame]:
    frames = encode_set(
        index=index, accel_m_s2=(0, 0, 9.8), gyro_rad_s=(0, 0, 0), euler_rad=(0, 0, 0), temperature_c=20,
        base_id=base_id,
    )  # fmt: skip
    return [CanFrame(can_id, False, data, 0) for can_id, data in frames]


class Round:
    def __init__(self, **more: object) -> None:
        self.search = CanSearch(DRIVERS, "can0", **more)  # type: ignore[arg-type]  # as the search takes them
        self.until_ns = self.search.start(0).until_ns
        self.early: CanFound | None = None

    def hear(self, *frames: CanFrame) -> "Round":
        for frame in frames:
            self.early = self.early or self.search.on_frames([frame])
        return self

    def end(self) -> CanStep:
        step = self.search.on_time(self.until_ns)
        while isinstance(step, Listen):
            self.until_ns = step.until_ns
            step = self.search.on_time(self.until_ns)
        assert step is not None
        return step

    def found(self) -> str:
        step = self.end()
        assert isinstance(step, CanFound), step
        return step.device.title

    def complaint(self) -> str:
        step = self.end()
        assert isinstance(step, GaveUp), step
        return step.summary


def test_one_device_is_found_and_several_are_listed() -> None:
    heard = Round().hear(fake_can_frame(8), fake_can_frame(8, 1))
    assert heard.early is None
    assert heard.search.on_time(LISTEN_NS - 1) is None
    assert heard.found() == "fake-can node 8"
    assert heard.until_ns == LISTEN_NS
    assert Round().hear(*imu61x(1), *imu61x(2)).found() == "imu61x-can base_id 101"
    random = Random(7)
    strangers = [CanFrame(0x400 + random.randrange(100), False, random.randbytes(3), 0) for _ in range(50)]
    assert Round().hear(*strangers, fake_can_frame(8), *strangers, fake_can_frame(8, 1)).found() == "fake-can node 8"
    frames = [f for n in (1, 2) for f in (fake_can_frame(8, n), fake_can_frame(9, n), *imu61x(n))]
    assert Round().hear(*frames).complaint() == (
        "3 devices send on can0: fake-can node 8, fake-can node 9, imu61x-can base_id 101; configure driver and options"
    )
    unnamed = fake_can_frame(8)._replace(data=b"7 bytes")
    assert Round().hear(unnamed, fake_can_frame(8), fake_can_frame(8, 1)).found() == "fake-can node 8"


def test_incomplete_samples_extend_the_round_and_are_reported() -> None:
    heard = Round().hear(*imu61x(1))
    step = heard.search.on_time(heard.until_ns)
    assert isinstance(step, Listen)
    heard.until_ns = step.until_ns
    heard.hear(*imu61x(2))
    assert heard.found() == "imu61x-can base_id 101"
    heard = Round().hear(*imu61x(1)[:3], *imu61x(2)[:3])
    assert heard.complaint() == (
        "frames of imu61x-can base_id 101 arrive on can0, but no complete sample; configure driver and options"
    )
    assert heard.until_ns == 6 * NS_PER_S
    first, second = imu61x(1), imu61x(2)
    heard = Round().hear(*imu61x(0), *first[:2], second[2]._replace(after_loss=True), *second[3:])
    assert [device.title for device in heard.search.survey.doubtful()] == ["imu61x-can base_id 101"]


def test_unknown_frames_and_silence_are_reported() -> None:
    frames = [CanFrame(0x18FEE9AA, True, bytes(8), 0), CanFrame(0x65, True, bytes(8), 0), CanFrame(0x7, False, b"", 0)]
    assert Round().hear(*frames).complaint() == (
        "frames of unknown types arrive on can0 (0x007, PGN 0 (0x0000) from source 101, "
        "PGN 65257 (0xFEE9) from source 170); configure driver and options"
    )
    many = [CanFrame(number, False, b"", 0) for number in range(12)]
    assert "0x007 and 4 more" in Round().hear(*many).complaint()
    assert "no frame arrives on can0" in Round().complaint()


def test_claimed_devices_are_not_found_and_a_remembered_device_is_found_if_it_is_free() -> None:
    claimed = {BASE + 8}
    heard = Round(claimed=lambda can_id, extended: can_id in claimed and not extended)
    heard.hear(*(fake_can_frame(node, n) for n in (1, 2) for node in (8, 9)))
    assert heard.found() == "fake-can node 9"
    claimed.add(BASE + 9)  # another search has found it in the meantime
    assert "only frames of other configured devices" in heard.complaint()
    heard = Round(claimed=lambda can_id, _: can_id == 0x7AA)
    heard.hear(*(CanFrame(can_id, False, bytes(8), 0) for can_id in (0x7AA, 0x7AB)))
    assert "unknown types arrive on can0 (0x7AB);" in heard.complaint()
    heard = Round(remembered=("fake-can", 9))
    heard.hear(fake_can_frame(8, 1), fake_can_frame(9, 1), fake_can_frame(8, 2))
    assert heard.early is None
    heard.hear(fake_can_frame(9, 2))
    assert heard.early is not None
    assert heard.early.device.title == "fake-can node 9"
    heard = Round(remembered=("fake-can", 9), claimed=lambda can_id, _: can_id == BASE + 9)
    heard.hear(*(fake_can_frame(9, n) for n in range(5)))
    assert heard.early is None


@pytest.mark.parametrize("driver", of_kind(TABLE.values(), CanDriver), ids=lambda driver: driver.name)
def test_two_samples_are_enough(driver: CanDriver) -> None:
    """The frames of the second sample end with the round."""
    search = CanSearch([driver], "can0")
    search.start(0)
    for number in range(2):
        frames = enumerate(driver.example_frames(Random(number)))
        search.on_frames([f._replace(t_rx_ns=(10 * number + place) * NS_PER_MS) for place, f in frames])
    assert isinstance(search.on_time(LISTEN_NS), CanFound)


def test_only_drivers_with_samples_are_listed() -> None:
    """A second driver recognizes the same frames, but decodes no sample."""
    search = CanSearch([fake_can_driver("wrong", BASE - 1), FAKE], "can0")
    search.start(0)
    search.on_frames([fake_can_frame(8, 1), fake_can_frame(8, 2)])
    step = search.on_time(LISTEN_NS)
    assert isinstance(step, CanFound)
    assert step.device.title == "fake-can node 8"
    search = CanSearch([fake_can_driver("twin"), FAKE], "can0")
    search.start(0)
    search.on_frames([fake_can_frame(8, 1), fake_can_frame(8, 2)])
    step = search.on_time(LISTEN_NS)
    assert isinstance(step, GaveUp)
    assert "twin node 8, fake-can node 8" in step.summary


@pytest.mark.parametrize("extended", [False, True])
def test_noise_on_the_bus_uses_limited_memory(extended: bool) -> None:
    survey, random = CanSurvey([fake_can_driver(base=0), fake_can_driver("other", 128), FAKE]), Random(3)
    most = 0x1FFF_FFFF if extended else 0x7FF
    for _ in range(IDENTIFIERS_MAX + 500):
        survey.on_frames([CanFrame(random.randint(0, most), extended, random.randbytes(8), 0)])
    assert len(survey.others()) == IDENTIFIERS_MAX or not extended
    assert len(survey.devices()) + len(survey.doubtful()) == (0 if extended else DEVICES_MAX)
