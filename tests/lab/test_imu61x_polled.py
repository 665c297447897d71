"""The IMU61x on i2c-dev and spidev of the kernel: detection by id, setup, stream, faults, recovery."""

import errno

import pytest

from imud.contracts.codec import Poll
from imud.contracts.status import DeviceState
from imud.drivers.imu61x import i2c as device_i2c
from imud.drivers.imu61x import spi
from imud.drivers.imu61x.i2c import READ_ID
from imud.drivers.imu61x.spi import READ_STATE
from imud.sim.imu61x.uart import REGISTER_VARIANTS
from tests.lab.bus import Bus, RegisterDevice
from tests.lab.imu61x_bus import LIMIT_S, comes_back, on_i2c, on_spi, physics_holds, registers, vanishes
from tests.lab.short_form import cases
from tests.lab.tool import demo
from tests.lab.wire import I2cTransfer, SpiTransfer
from tests.support.device_rig import DeviceRig, device_config, running

RESOLUTION_M_S2 = 0.02
ADDRESS = 0x1A


@pytest.mark.manual("A 3.1 rate")
async def test_found_by_its_id_and_streams_the_truth(i2c: Bus[I2cTransfer]) -> None:
    """Another sensor replies at the first address. The device is at the third address."""
    other = RegisterDevice({0x6A: 0x12})
    device = registers(product="IMU6132B")
    i2c.attach(0x18, other)
    i2c.attach(ADDRESS, on_i2c(device))
    config = device_config("imu", "imu61x-i2c", "i2c", {"bus": 0, "rate_hz": 20}, accel_filter=2)
    async with running(config) as (rig,):
        await rig.until_samples(20, LIMIT_S)
        status = rig.device.status()
        assert (status.identity, status.link) == ({"product": "IMU6132B"}, "/dev/i2c-0, address 0x1a")
        assert status.settings == {"accel_filter": "2 Hz", "gyro_filter": "47 Hz"}
        assert device.filter == 0x2B
        physics_holds(rig, device, RESOLUTION_M_S2)
    assert not any(other.registers[register] for register in range(0x20)), "nothing is written to another device"
    bursts = [t for t in i2c.transfers if t.segments[0].data == b"\x12"]
    assert len(bursts) >= 20
    assert {tuple((s.reads, s.length) for s in t.segments) for t in bursts} == {((False, 1), (True, 32))}


FAULTS: dict[str, tuple[dict[str, object], str]] = {
    "not acknowledged": ({"error": errno.ENXIO}, "no acknowledgement"),
    "not acknowledged, as on a Raspberry Pi": ({"error": errno.EREMOTEIO}, "no acknowledgement"),
    "bus stuck": ({"error": errno.ETIMEDOUT}, "held low"),
    "arbitration lost again and again": ({"error": errno.EAGAIN}, "transfer failed"),
    "line high": ({"line": 0xFF}, "received only 0xFF"),
    "line low": ({"line": 0x00}, "received only 0x00"),
    "wrong id": ({"product_id": b"\x00\x00ICM206"}, "product id"),
    "damaged for good": ({"flips": 1000}, "damaged frames"),
}


@pytest.mark.parametrize("fault", cases(FAULTS, "bus stuck", "line high", "wrong id"))
async def test_vanishes_and_is_identified_before_it_is_believed(
    i2c: Bus[I2cTransfer], fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    polls = (Poll(device_i2c.READ_BURST), Poll(READ_ID, 10**8))
    if fault == "wrong id":  # with the other faults, the readings also show the fault, and earlier
        monkeypatch.setattr(device_i2c.Imu61xI2cCodec, "polls", polls)
    device = registers()
    i2c.attach(ADDRESS, on_i2c(device))
    config = device_config("imu", "imu61x-i2c", "i2c", {"bus": 0, "address": ADDRESS, "rate_hz": 20})
    values, why = FAULTS[fault]
    async with running(config) as (rig,):
        await rig.until_samples(3, LIMIT_S)
        for name, value in values.items():
            setattr(device.faults, name, value)
        await vanishes(rig, why)
        device.faults = type(device.faults)()
        await comes_back(rig)


async def test_unplugged_and_plugged(i2c: Bus[I2cTransfer]) -> None:
    device = registers()
    i2c.attach(0x18, on_i2c(device))
    config = device_config("imu", "auto", "i2c", {"bus": 0, "rate_hz": 20})
    async with running(config) as (rig,):
        await rig.until_samples(3, LIMIT_S)
        i2c.detach(0x18)
        await vanishes(rig, "no acknowledgement")
        i2c.attach(0x1B, on_i2c(device))  # the address of the device changes
        await comes_back(rig)
        assert rig.device.status().link == "/dev/i2c-0, address 0x1b"


async def test_repeated_bytes_are_counted_and_no_samples(i2c: Bus[I2cTransfer]) -> None:
    device = registers()
    i2c.attach(0x18, on_i2c(device))
    config = device_config("imu", "imu61x-i2c", "i2c", {"bus": 0, "rate_hz": 20})
    async with running(config) as (rig,):
        await rig.until_samples(3, LIMIT_S)
        device.faults.frozen = True
        await rig.until(lambda: rig.state is DeviceState.SILENT, "silent", LIMIT_S)
        polling = rig.device.status().polling
        assert polling is not None
        assert polling.stale > 5
        assert rig.device.ledger.frames_ignored == polling.stale
        device.faults.frozen = False
        await comes_back(rig)


async def test_two_devices_on_one_bus_are_found_by_themselves(i2c: Bus[I2cTransfer]) -> None:
    first, second = registers(product="IMU612"), registers(product="IMU618")
    i2c.attach(0x18, on_i2c(first))
    i2c.attach(0x19, on_i2c(second))
    configs = [device_config(name, "imu61x-i2c", "i2c", {"bus": 0, "rate_hz": 20}) for name in ("a", "b")]
    async with running(*configs) as (a, b):
        await a.until_samples(5, LIMIT_S)
        await b.until_samples(5, LIMIT_S)
        links = {rig.device.status().link for rig in (a, b)}
        assert links == {"/dev/i2c-0, address 0x18", "/dev/i2c-0, address 0x19"}


@pytest.mark.timeout(240)
def test_demo_on_a_bus_that_exists(i2c: Bus[I2cTransfer]) -> None:
    i2c.attach(ADDRESS, on_i2c(registers()))
    printed = demo("--device", "imu61x-i2c", "--bus", "0", "--rate", "20", "--duration", "5")
    assert "link      running; /dev/i2c-0, address 0x1a, driver imu61x-i2c" in printed
    assert "reads, " in printed
    assert printed.rstrip().endswith("the ledger balances")


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
        applied = await rig.device.settings.apply({"gyro_filter": "10 Hz"}, save=False)
        assert device.filter == 0xB4
        assert rig.device.status().settings["gyro_filter"] == "10 Hz", applied
        await rig.until_samples(5, LIMIT_S)
        assert rig.device.ledger.frames_bad_crc == 0
        assert device.window == 0


SPI_FAULTS: dict[str, tuple[dict[str, object], str]] = {
    "unplugged, line high": ({"line": 0xFF}, "received only 0xFF"),
    "unplugged, line low": ({"line": 0x00}, "received only 0x00"),
    "wrong id": ({"product_id": b"\x00\x00ICM206"}, "PROD_ID"),
    "bus stuck": ({"error": errno.ETIMEDOUT}, "held low"),
    "controller error": ({"error": errno.EIO}, "transfer failed"),
}


@pytest.mark.parametrize("fault", cases(SPI_FAULTS, "unplugged, line high", "wrong id"))
async def test_spi_vanishes_and_is_identified_before_it_is_believed(
    bus: tuple[Bus[SpiTransfer], str], fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spi, "POLLS", {"standard": (spi.POLLS["standard"][0], Poll(READ_STATE, 10**8))})
    far, port = bus
    device = registers()
    far.attach(0, on_spi(device))
    config = device_config("imu", "imu61x-spi", "spi", {"port": port, "rate_hz": 20})
    values, why = SPI_FAULTS[fault]
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
def test_demo_on_spi(spi8: Bus[SpiTransfer]) -> None:
    spi8.attach(0, on_spi(registers()))
    printed = demo("--device", "imu61x-spi", "--port", "/dev/spidev0.0", "--rate", "20", "--duration", "5")
    assert "link      running; /dev/spidev0.0, mode 0, driver imu61x-spi" in printed
    assert "reads, " in printed
    assert printed.rstrip().endswith("the ledger balances")
