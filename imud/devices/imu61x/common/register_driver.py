"""Settings, set-up, action and row of the Forsense IMU61x on SPI and I2C, where only the transfers differ.

Of what can be changed over these buses only the low-pass filters concern the user; all else is set over the UART.
"""

from collections.abc import Callable, Mapping, Sequence
from random import Random
from typing import Annotated, Any, Final, TypeVar

import msgspec
from msgspec import Meta

from imud.contracts.action import Action, Target
from imud.contracts.driver import Identity, KeyProblem
from imud.contracts.polling import PolledCodec, PolledDriver, TransferScript
from imud.contracts.settings import Settings
from imud.devices.imu61x.common.family import (
    EULER_CONVENTION,
    FILTERS,
    NAVIGATION_FRAME,
    FilterCode,
    filter_codes,
    filter_control,
    product_of,
    relative_heading,
)
from imud.devices.polled_frames import absence
from imud.errors import BadArgument, DeviceRefused
from imud.frames.conventions import FLU_LEVEL
from imud.ledger import Ledger
from imud.units import NS_PER_S

CHECK_NS: Final = 10 * NS_PER_S
"""Interval of reading identity and settings again: a device that restarted by itself has lost unsaved settings."""


class RegisterSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of an IMU61x on a polled bus."""

    accel_filter: FilterCode | None = None
    """Low-pass filter of the accelerometer, code 0 to 15 of table 21 (11: 47 Hz); null leaves it as it is."""
    gyro_filter: FilterCode | None = None
    """The same of the gyroscope."""
    update_hz: Annotated[float, Meta(ge=0, le=10000)] = 0.0
    """Rate at which the device renews its registers, per second, for the error of time stamps; 0 if not known."""


S = TypeVar("S", bound=RegisterSettings)
SetUp = Callable[[S], TransferScript[Mapping[str, str]]]


# --- identity and filters --------------------------------------------------------------------------------------------


def identity_of(product_id: bytes) -> Identity:
    """The identity that PROD_ID states. Raises DeviceRefused for another device, with what to look at."""
    product = product_of(product_id)
    if product is None:
        why = absence(product_id) or "another device, or the wrong SPI mode or speed?"
        raise DeviceRefused(f"PROD_ID: expected 00 00 'IMU61' and a letter, got {product_id.hex(' ')}: {why}")
    return Identity(product=product)


def wanted_filter(settings: RegisterSettings, present: int) -> int:
    """The value that FILTER_CTRL should have, from the value that it has."""
    accel, gyro = filter_codes(present)
    return filter_control(
        accel if settings.accel_filter is None else settings.accel_filter,
        gyro if settings.gyro_filter is None else settings.gyro_filter,
    )


def check_filter(wanted: int, got: int) -> None:
    """Check what FILTER_CTRL reads back after a write. Raises DeviceRefused if it is not the value written."""
    if got & 0xFF != wanted:
        raise DeviceRefused(f"FILTER_CTRL: wrote {wanted:#04x}, read back {got & 0xFF:#04x}; is the bus too fast?")


def filter_words(control: int) -> Mapping[str, str]:
    """The filters by name, for people."""
    accel, gyro = filter_codes(control)
    return {"accel_filter": FILTERS[accel], "gyro_filter": FILTERS[gyro]}


# --- action and row --------------------------------------------------------------------------------------------------

AccelFilter = Annotated[
    FilterCode | None,
    Meta(description="low-pass filter of the accelerometer, code of table 21 (11: 47 Hz); null leaves it as it is"),
]
GyroFilter = Annotated[FilterCode | None, Meta(description="the same of the gyroscope")]


def _filter_action(set_up: SetUp[S]) -> Action:
    """Set the filters by the driver's own `set_up`, which reads them back."""

    def set_filter(
        target: Target, *, accel_filter: AccelFilter = None, gyro_filter: GyroFilter = None
    ) -> TransferScript[Mapping[str, str]]:
        settings: S = target.settings
        given = {"accel_filter": accel_filter, "gyro_filter": gyro_filter}
        wanted = {name: code for name, code in given.items() if code is not None}
        for name, code in wanted.items():
            if (configured := getattr(settings, name)) not in (None, code):
                raise BadArgument(f"{name}: expected {configured}, which `options.{name}` says, got {code}")
        return set_up(msgspec.structs.replace(settings, **wanted))

    return Action(
        "set the low-pass filters until the device restarts, and answer what they are; "
        "`options` set them at every start",
        set_filter,
    )


def register_driver(
    bus: str,
    settings: type[S],
    targets: tuple[int, ...],
    probe: Callable[[S], TransferScript[Identity]],
    set_up: SetUp[S],
    make_codec: Callable[[Ledger, Any], PolledCodec],
    example_reading: Callable[[Random], bytes],
    read_ns: Callable[[Any, Any], int],
) -> PolledDriver:
    """The row of the driver on `bus` (`i2c` or `spi`)."""

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
        title=f"Forsense IMU612, IMU614, IMU618, IMU6132A, IMU6132B ({bus.upper()})",
        settings=settings,
        euler_convention=EULER_CONVENTION,
        navigation_frame=NAVIGATION_FRAME,
        axes=FLU_LEVEL,
        heading=relative_heading,
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
        actions={"filter": _filter_action(set_up)},
    )


def _update_ns(settings: RegisterSettings) -> int:
    """Time between two updates of the registers; 0 for not known."""
    return int(NS_PER_S / settings.update_hz) if settings.update_hz else 0
