"""Options, setup, settings and registry row of the Forsense IMU61x on SPI and I2C. Only the transfers differ.

Users change only the low-pass filters over these buses; the UART changes all other settings.
"""

from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import Annotated, Any, Final, NamedTuple, TypeVar

from msgspec import Meta

from imud.attitude.conventions import FLU_LEVEL
from imud.contracts.codec import PolledCodec
from imud.contracts.command import Target
from imud.contracts.driver import Identity, KeyProblem, PolledDriver
from imud.contracts.script import TransferScript
from imud.contracts.setting import DeviceReport, Reports, Setting, SettingsTable
from imud.drivers.imu61x.common import (
    ACCEL_FILTER,
    EULER_CONVENTION,
    FILTERS,
    GYRO_FILTER,
    M_S2_PER_G,
    NAVIGATION_FRAME,
    RAD_S_PER_DEG_S,
    SHEET,
    FilterChoice,
    filter_code,
    filter_codes,
    filter_control,
    product_of,
    relative_heading,
    same_filter,
)
from imud.drivers.polled_frames import absence
from imud.model.errors import BadArgument, DeviceRefused
from imud.model.ledger import Ledger
from imud.model.options import Options
from imud.model.units import NS_PER_S

# Time between two reads of identity and settings, ns: a device that restarted has lost unsaved settings
CHECK_NS: Final = 10 * NS_PER_S


class RegisterOptions(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of an IMU61x on a polled bus."""

    accel_filter: FilterChoice | None = None
    """Low-pass filter of the accelerometer, by name or by code in the order of the names (11: 47 Hz); null:
    unchanged."""
    gyro_filter: FilterChoice | None = None
    """Low-pass filter of the gyroscope, as for the accelerometer."""
    update_hz: Annotated[float, Meta(ge=0, le=10000)] = 0.0
    """Update rate of the device registers, per second, for the time stamp error; 0 if it is not known."""


S = TypeVar("S", bound=RegisterOptions)
SetUp = Callable[[S], TransferScript[Reports]]


# --- identity and filters --------------------------------------------------------------------------------------------


def identity_of(product_id: bytes) -> Identity:
    """Return the identity in PROD_ID. Raises DeviceRefused for another device, with the next step."""
    product = product_of(product_id)
    if product is None:
        why = absence(product_id) or "is it another device, or the wrong SPI mode or speed?"
        raise DeviceRefused(f"PROD_ID: expected 00 00 'IMU61' and a letter, got {product_id.hex(' ')}: {why}")
    return Identity(product=product)


def wanted_filter(settings: RegisterOptions, present: int) -> int:
    """Return the wanted value of FILTER_CTRL for its present value."""
    accel, gyro = filter_codes(present)
    return filter_control(
        accel if settings.accel_filter is None else filter_code(settings.accel_filter),
        gyro if settings.gyro_filter is None else filter_code(settings.gyro_filter),
    )


def check_filter(wanted: int, got: int) -> None:
    """Raise DeviceRefused if FILTER_CTRL differs after a write."""
    if got & 0xFF != wanted:
        raise DeviceRefused(
            f"FILTER_CTRL: expected {wanted:#04x} after the write, got {got & 0xFF:#04x}; try a slower bus"
        )


def report_of(control: int, **more: str) -> Reports:
    """Return the only report of the device: the names of the filters, and more settings with the same text."""
    accel, gyro = filter_codes(control)
    settings = {"accel_filter": FILTERS[accel], "gyro_filter": FILTERS[gyro], **more}
    return {"": DeviceReport(settings, settings)}


# --- settings and verb ----------------------------------------------------------------------------------------------

AccelFilter = Annotated[FilterChoice, ACCEL_FILTER]
GyroFilter = Annotated[FilterChoice, GYRO_FILTER]


class FilterControl(NamedTuple):
    """Scripts of a bus that read and write FILTER_CTRL."""

    read: Callable[[], TransferScript[int]]
    write: Callable[[int], TransferScript[None]]  # Reads back the written value. Raises DeviceRefused.


def filter_settings(control: FilterControl) -> Mapping[str, Setting]:
    """Return the two filters as settings. A restart of the device resets them; the UART saves them."""

    def write(target: Target, accel: FilterChoice | None, gyro: FilterChoice | None) -> TransferScript[None]:
        _require_as_configured(target.settings, accel_filter=accel, gyro_filter=gyro)
        present_accel, present_gyro = filter_codes((yield from control.read()))
        yield from control.write(
            filter_control(
                present_accel if accel is None else filter_code(accel),
                present_gyro if gyro is None else filter_code(gyro),
            )
        )

    return {
        "accel_filter": Setting(
            type=AccelFilter, write=lambda target, choice: write(target, choice, None), agrees=same_filter
        ),
        "gyro_filter": Setting(
            type=GyroFilter, write=lambda target, choice: write(target, None, choice), agrees=same_filter
        ),
    }


def check_settings(target: Target, values: Mapping[str, Any]) -> None:
    """Raise BadArgument for a filter that differs from `options`."""
    if isinstance(target.settings, RegisterOptions):
        filters = {name: values.get(name) for name in ("accel_filter", "gyro_filter")}
        _require_as_configured(target.settings, **filters)


def _require_as_configured(settings: RegisterOptions, **wanted: FilterChoice | None) -> None:
    """Raise BadArgument for a filter that differs from `options`, which imud writes again at every setup."""
    for name, choice in wanted.items():
        configured: FilterChoice | None = getattr(settings, name)
        if choice is not None and configured is not None and not same_filter(choice, configured):
            raise BadArgument(f"{name}: expected {_shown(configured)} from `options.{name}`, got {_shown(choice)}")


def _shown(choice: FilterChoice) -> str:
    return f"{FILTERS[filter_code(choice)]} (code {filter_code(choice)})"


# --- row --------------------------------------------------------------------------------------------------------------


def register_driver(
    bus: str,
    settings: type[S],
    targets: tuple[int, ...],
    probe: Callable[[S], TransferScript[Identity]],
    set_up: SetUp[S],
    make_codec: Callable[[Ledger, Any], PolledCodec],
    example_reading: Callable[[Random], bytes],
    read_ns: Callable[[Any, Any], int],
    device_settings: SettingsTable,
) -> PolledDriver:
    """Return the registry row of the driver on `bus` (`i2c` or `spi`)."""

    def check(_options: S, link: Any) -> Sequence[KeyProblem]:
        address = getattr(link, "address", "auto")
        if address == "auto" or address in targets:
            return ()
        known = ", ".join(f"{target:#04x}" for target in targets)
        return (
            KeyProblem("link", "address", f"expected an address of an IMU61x ({known}) or auto, got {address:#04x}"),
        )

    return PolledDriver(
        name=f"imu61x-{bus}",
        never_sends=frozenset({"incli_rad", *(("euler_rad",) if bus == "i2c" else ())}),
        title=f"Forsense IMU612, IMU614, IMU618, IMU6132A, IMU6132B ({bus.upper()})",
        settings=settings,
        euler_convention=EULER_CONVENTION,
        navigation_frame=NAVIGATION_FRAME,
        data_sheet=SHEET,
        axes=FLU_LEVEL,
        heading=relative_heading,
        sends_attitude=lambda options: getattr(options, "burst", "") == "extended",
        lines=frozenset({"reset", "data_ready"}),
        link=bus,
        targets=targets,
        probe=probe,
        set_up=set_up,
        make_codec=make_codec,
        update_ns=_update_ns,
        example_reading=example_reading,
        read_ns=read_ns,
        check=check,
        device_settings=device_settings,
        renamed={"filter": "accel_filter={accel_filter} gyro_filter={gyro_filter}"},
    )


def _update_ns(settings: RegisterOptions) -> int:
    """Return the time between two updates of the registers, ns; 0 if it is not known."""
    return int(NS_PER_S / settings.update_hz) if settings.update_hz else 0


BURST: Final = 0x00
FILTER_CTRL: Final = 0x06
# The high byte at 0x0D selects the burst: 0 standard, 1 extended (value of the vendor's programs, not of the manual)
BURST_CTRL: Final = 0x0C
TEMP_HIGH: Final = 0x0E
ZACCEL_LOW: Final = 0x28
PROD_ID: Final = 0x6A  # first of four words, 0x6A to 0x70; on I2C of eight bytes
WIN_CTRL: Final = 0x7E
I2C_BURST: Final = 0x12  # address in section 3.3.1; table 26 prints 0x00

M_S2_PER_COUNT: Final = 0.2 / 65536 * M_S2_PER_G  # burst: 327680 counts are 1 g
# Single registers: 65536 counts, one step of the high word, are 0.0002 g
M_S2_PER_COUNT_REGISTER: Final = 0.2 / 1000 / 65536 * M_S2_PER_G
RAD_S_PER_COUNT: Final = 0.016 / 65536 * RAD_S_PER_DEG_S  # burst and single registers: 4096000 counts are 1 °/s
TEMPERATURE_ZERO_COUNTS: Final = 172_621_824  # 2634 · 65536: the count at 25 °C
C_PER_COUNT: Final = -1 / 263.4 / 65536


def temperature_c(counts: int) -> float:
    """Return the temperature of TEMP from the joined high and low word."""
    return (counts - TEMPERATURE_ZERO_COUNTS) * C_PER_COUNT + 25.0


def temperature_counts(celsius: float) -> int:
    """Return the counts of a temperature, for simulated devices."""
    return round((celsius - 25.0) / C_PER_COUNT) + TEMPERATURE_ZERO_COUNTS
