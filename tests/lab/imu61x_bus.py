"""The simulated IMU61x behind the buses of the kernel module, and common parts of the tests of both buses."""

from collections.abc import Callable
from math import dist
from time import monotonic_ns

from imud.model.event import EventKind
from imud.sim.imu61x.registers import Imu61xRegisters
from tests.lab.wire import I2cTransfer, Refuse, SpiTransfer
from tests.support.device_rig import DeviceRig

LIMIT_S = 40.0


def on_spi(device: Imu61xRegisters) -> Callable[[SpiTransfer], bytes]:
    def answer(transfer: SpiTransfer) -> bytes:
        selections = [b"".join(segment.mosi for segment in group) for group in transfer.selections]
        try:
            return b"".join(device.spi(selections, transfer.mode & 3))
        except OSError as error:
            raise Refuse(error.errno or 0) from error

    return answer


def on_i2c(device: Imu61xRegisters) -> Callable[[I2cTransfer], bytes]:
    def answer(transfer: I2cTransfer) -> bytes:
        try:
            return device.i2c([segment.length if segment.reads else segment.data for segment in transfer.segments])
        except OSError as error:
            raise Refuse(error.errno or 0) from error

    return answer


def registers(**more: object) -> Imu61xRegisters:
    return Imu61xRegisters(monotonic_ns, **more)  # type: ignore[arg-type]  # passed on as given


def physics_holds(rig: DeviceRig, device: Imu61xRegisters, resolution_m_s2: float) -> None:
    stamps = [sample.t_ns for sample in rig.samples]
    assert stamps == sorted(set(stamps))
    assert [sample.seq for sample in rig.samples] == list(range(1, len(stamps) + 1))
    for sample in rig.samples[-20:]:
        assert sample.accel_m_s2 is not None
        assert sample.t_ns <= sample.t_rx_ns
        reach = 3 * sample.t_err_ns
        truths = (device.truth_at(sample.t_ns + reach * n // 50) for n in range(-50, 51))
        off = min(dist(sample.accel_m_s2, truth.accel_m_s2) for truth in truths)
        assert off < resolution_m_s2, off


async def vanishes(rig: DeviceRig, why: str) -> None:
    def told() -> bool:
        return any(event.kind is EventKind.DOWN and why in event.message for event in rig.events)

    await rig.until(told, why, LIMIT_S)


async def comes_back(rig: DeviceRig) -> None:
    await rig.until_samples(5, LIMIT_S)
    flow = [kind for kind in rig.kinds if kind in (EventKind.UP, EventKind.DOWN)]
    assert flow == [EventKind.UP, EventKind.DOWN] * (len(flow) // 2) + [EventKind.UP]
    assert len(flow) >= 3
