"""The IMU61x on spidev of the kernel: identify, setup, stream, faults, recovery, with 8-bit words and 16-bit words."""

import errno

import pytest

from imud.contracts.codec import Poll
from imud.contracts.status import DeviceState
from imud.drivers.imu61x import spi
from imud.drivers.imu61x.spi import READ_STATE
from imud.sim.imu61x.uart import REGISTER_VARIANTS
from tests.lab.bus import Bus
from tests.lab.demo import demo
from tests.lab.imu61x_bus import LIMIT_S, comes_back, on_spi, physics_holds, registers, vanishes
from tests.lab.short_form import cases
from tests.lab.wire import SpiTransfer
from tests.support.device_rig import DeviceRig, device_config, running

RESOLUTION_M_S2 = 0.02  # tolerance for the 16-bit registers
PORTS = {"spi8": "/dev/spidev0.0", "spi16": "/dev/spidev1.0"}


@pytest.fixture(params=list(PORTS))
def bus(request: pytest.FixtureRequest) -> tuple[Bus[SpiTransfer], str]:
    return request.getfixturevalue(request.param), PORTS[request.param]


@pytest.mark.parametrize("burst", ["standard", "extended", "registers"])
async def test_streams_the_truth(bus: tuple[Bus[SpiTransfer], str], burst: str) -> None:
    far, port = bus
    device = registers(modes=frozenset({3}))
    far.attach(0, on_spi(device))
    config = device_config(
        "imu", "imu61x-spi", "spi", {"port": port, "rate_hz": 20, "speed_hz": 500_000}, burst=burst, gyro_filter=3
    )
    async with running(config) as (rig,):
        await rig.until_samples(20, LIMIT_S)
        status = rig.device.status()
        assert (status.identity, status.link) == ({"product": "IMU614"}, f"{port}, mode 3")
        assert (status.settings["gyro_filter"], status.ledger["frames_bad_crc"]) == ("5 Hz", 0)
        assert (device.filter, device.window) == (0xB3, 0)
        physics_holds(rig, device, RESOLUTION_M_S2)
    sizes = {"standard": 32, "extended": 52, "registers": 2}
    bursts = [
        t for t in far.transfers if len(t.segments[0].mosi) == sizes[burst] and t.segments[0].mosi[0] in (0x80, 0x0E)
    ]
    assert len(bursts) >= 20
    bits = 8 if port == PORTS["spi8"] else 16
    assert {(s.bits_per_word, s.speed_hz) for t in bursts for s in t.segments} == {(bits, 500_000)}
    if burst != "registers":  # one ioctl, one activation of chip select
        assert {len(t.segments) for t in bursts} == {1}
        assert not any(t.stays_selected for t in bursts)


@pytest.mark.parametrize("variant", cases(REGISTER_VARIANTS, "BURST_CTRL reads zero"))
@pytest.mark.parametrize("burst", ["standard", "extended"])
async def test_kind_of_burst_in_every_variant(spi8: Bus[SpiTransfer], variant: str, burst: str) -> None:
    """The driver selects the burst for each place of BURST_CTRL and each value of the undefined bits of WIN_CTRL."""
    device = registers(behaviour=REGISTER_VARIANTS[variant])
    device.extended = 1 if burst == "standard" else 0
    spi8.attach(0, on_spi(device))
    config = device_config("imu", "imu61x-spi", "spi", {"port": PORTS["spi8"], "rate_hz": 20}, burst=burst)
    async with running(config) as (rig,):
        await rig.until_samples(10, LIMIT_S)
        assert rig.device.status().settings["burst"] == burst
        assert device.extended == (burst == "extended")
        applied = await rig.device.settings_apply({"gyro_filter": "10 Hz"}, save=False)
        assert device.filter == 0xB4
        assert rig.device.status().settings["gyro_filter"] == "10 Hz", applied
        await rig.until_samples(5, LIMIT_S)
        assert rig.device.ledger.frames_bad_crc == 0
        assert device.window == 0


FAULTS: dict[str, tuple[dict[str, object], str]] = {
    "unplugged, line high": ({"line": 0xFF}, "received only 0xFF"),
    "unplugged, line low": ({"line": 0x00}, "received only 0x00"),
    "wrong id": ({"product_id": b"\x00\x00ICM206"}, "PROD_ID"),
    "bus stuck": ({"error": errno.ETIMEDOUT}, "held low"),
    "controller error": ({"error": errno.EIO}, "transfer failed"),
}


@pytest.mark.parametrize("fault", cases(FAULTS, "unplugged, line high", "wrong id"))
async def test_vanishes_and_is_identified_before_it_is_believed(
    bus: tuple[Bus[SpiTransfer], str], fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spi, "POLLS", {"standard": (spi.POLLS["standard"][0], Poll(READ_STATE, 10**8))})
    far, port = bus
    device = registers()
    far.attach(0, on_spi(device))
    config = device_config("imu", "imu61x-spi", "spi", {"port": port, "rate_hz": 20})
    values, why = FAULTS[fault]
    async with running(config) as (rig,):
        await rig.until_samples(3, LIMIT_S)
        for name, value in values.items():
            setattr(device.faults, name, value)
        await vanishes(rig, why)
        device.faults = type(device.faults)()
        device.restart()
        await comes_back(rig)
        assert rig.device.status().polling.vanished >= 1  # type: ignore[union-attr]  # this runner has it
        assert device.window == 0


async def test_damaged_bytes_cost_their_sample_only(spi8: Bus[SpiTransfer]) -> None:
    device = registers()
    spi8.attach(0, on_spi(device))
    config = device_config("imu", "imu61x-spi", "spi", {"port": PORTS["spi8"], "rate_hz": 20})

    async def damage(rig: DeviceRig) -> None:
        device.faults.flips = 1
        await rig.until(lambda: rig.device.ledger.frames_bad_crc >= 1, "the damage in the status", LIMIT_S)

    async with running(config) as (rig,):
        await rig.until_samples(5, LIMIT_S)
        await damage(rig)
        await rig.until_samples(5, LIMIT_S)
        assert rig.state is DeviceState.RUNNING
        assert rig.device.ledger.lost_crc == 1
        physics_holds(rig, device, RESOLUTION_M_S2)


async def test_absent_device_does_not_hold_up_its_neighbour(spi8: Bus[SpiTransfer]) -> None:
    device = registers()
    spi8.attach(1, on_spi(device))
    configs = [
        device_config(name, "imu61x-spi", "spi", {"port": port, "rate_hz": 20})
        for name, port in (("absent", "/dev/spidev0.0"), ("there", "/dev/spidev0.1"))
    ]
    async with running(*configs) as (absent, there):
        await there.until_samples(30, LIMIT_S)
        assert absent.state is DeviceState.SEARCHING
        await absent.until(lambda: "received only 0x00" in absent.device.status().problem, "the reason", LIMIT_S)


async def test_bus_that_goes_is_noticed(spi8: Bus[SpiTransfer]) -> None:
    device = registers()
    spi8.attach(0, on_spi(device))
    config = device_config("imu", "imu61x-spi", "spi", {"port": PORTS["spi8"], "rate_hz": 20})
    async with running(config) as (rig,):
        await rig.until_samples(3, LIMIT_S)
        spi8.close()
        await vanishes(rig, "no acknowledgement")


@pytest.mark.thorough
@pytest.mark.timeout(240)
def test_demo_on_a_bus_that_exists(spi8: Bus[SpiTransfer]) -> None:
    spi8.attach(0, on_spi(registers()))
    printed = demo("--device", "imu61x-spi", "--port", "/dev/spidev0.0", "--rate", "20", "--duration", "5")
    assert "link      /dev/spidev0.0, mode 0, driver imu61x-spi" in printed
    assert "reads, " in printed
    assert printed.rstrip().endswith("the ledger balances")
