"""Row `DRIVER` of HiPNUC devices on RS-485: verbs, calibrations and settings."""

from collections.abc import Mapping
from random import Random
from typing import Annotated, Any, Final, Literal

from msgspec import Meta

from imud.attitude.rotation import euler312_from_quat
from imud.contracts.command import Calibrations, Proof, Risk, Target, Verb, VerbResult, Verbs, Verdict
from imud.contracts.driver import PolledDriver, random_vector
from imud.contracts.script import TransferScript
from imud.contracts.setting import Effect, Setting, SettingsTable
from imud.drivers.hipnuc.common import (
    MAIN_STATUS,
    NINE_AXES_NEEDED,
    REGISTERS,
    AttitudeMode,
    LevelReset,
    heading_by_mode,
    levelled,
    levels,
    magnetometer,
    random_quaternion,
    save_verb,
)
from imud.drivers.hipnuc.modbus import commands
from imud.drivers.hipnuc.modbus.codec import HipnucModbusCodec, HipnucModbusOptions, pack_block, update_ns
from imud.drivers.hipnuc.modbus.commands import MODES, LineMounting, Mode, probe
from imud.drivers.hipnuc.modbus.registers import (
    BY_NAME,
    FACTORY_ID,
    ID_MAX,
    Access,
    BaudRate,
    registers_reply,
)
from imud.formats.modbus import SLAVES, framed
from imud.model.errors import BadArgument
from imud.model.units import NS_PER_MS


def _restart(target: Target) -> TransferScript[str | VerbResult]:
    return commands.restart(commands.places_of(target), target.baud)


def _factory_reset(target: Target) -> TransferScript[str]:
    return commands.factory_reset(commands.places_of(target), target.baud)


def _level(
    _target: Target, *, level: Annotated[Literal["relative", "automatic", "cancel"], Meta(extra={"section": "4.3.5"})]
) -> TransferScript[None]:
    return commands.auto_level(LevelReset[level.upper()])


def _read(
    _target: Target,
    *,
    register: Annotated[str, Meta(description="name of the register in the manual", extra={"section": "4.2"})],
) -> TransferScript[tuple[int, ...]]:
    found = BY_NAME.get(register.upper())
    if found is None or found.access is Access.WRITE:
        known = ", ".join(one.name for one in BY_NAME.values() if one.access is not Access.WRITE)
        raise BadArgument(f"register: expected one of {known}, got {register[:64]!r}")
    return commands.read(found)


VERBS: Final[Verbs] = {
    "save": save_verb(lambda _target: commands.save()),
    "restart": Verb(
        "restart the device and wait until it replies; unsaved settings are lost",
        _restart,
        restarts=True,
        proof=Proof.RESTART,
        evidence="the uptime restarts, the device moves to another address, or it reports other settings than before",
    ),
    "factory_reset": Verb(
        "restore the factory settings and restart: imud follows the device to address 80 if no other device uses it "
        "and the bus has the factory baud rate 115200",
        _factory_reset,
        Risk.RESET,
        restarts=True,
        proof=Proof.SETTINGS,
    ),
    "level": Verb(
        "make the present attitude level, or cancel it; the device must be at rest",
        _level,
        proof=Proof.SAMPLES,
        expected=levelled,
    ),
    "read": Verb("read a register as words of 16 bits", _read, changes=False),
}

RENAMED: Final[Mapping[str, str]] = {
    "address": "address={address}",
    "baud": "baud={baud} --save",
    "attitude_mode": "mode={axes}-axis",
    "mounting": "mounting={mounting} --save",
}

DONE_PERCENT: Final = 100


def _nine_axes_needed(_target: Target) -> TransferScript[str]:
    (mode,) = yield from commands.read(BY_NAME["HEADING_MODE"])
    if mode == AttitudeMode.SIX_AXIS.value:
        return NINE_AXES_NEEDED
    return ""


def _nothing_to_start(_target: Target) -> TransferScript[None]:
    # in 9-axis mode the device calibrates without a command
    return
    yield  # makes it a generator


def _magnetometer_verdict(_target: Target) -> TransferScript[Verdict]:
    (state,) = yield from commands.read(BY_NAME["MAG_CALIBRATION"])
    (percent,) = yield from commands.read(BY_NAME["MAG_PROGRESS"])
    return Verdict(percent >= DONE_PERCENT, f"state {state}, {percent} %", min(percent / DONE_PERCENT, 1.0))


CALIBRATIONS: Final[Calibrations] = {
    "magnetometer": magnetometer(_nothing_to_start, _magnetometer_verdict, _nine_axes_needed),
    **levels("4.3.5", 15, lambda kind: lambda _target: commands.auto_level(kind), lambda _target: commands.save()),
}

Mounting = Literal["level", "x_up", "x_down", "y_up", "y_down"]


def _check(target: Target, values: Mapping[str, Any]) -> None:
    """Raise BadArgument for another baud rate than the bus: such a device is lost and disturbs the others."""
    baud = values.get("baud")
    if baud is not None and target.baud and baud != target.baud:
        raise BadArgument(
            f"baud: expected {target.baud}, the baud rate of the bus, got {baud}; to change it, set it in all "
            "devices with `imud settings NAME --set baud=… --save`, restart them, then change `rs485.baud`"
        )


SETTINGS: Final = SettingsTable(
    table={
        "mode": Setting(
            type=Annotated[
                Mode,
                Meta(description="heading without or with the magnetometer", extra={"section": "4.3.6"}),
            ],
            write=lambda _target, mode: commands.set_heading_mode(MODES[mode]),
        ),
        "mounting": Setting(
            type=Annotated[Mounting, Meta(description="axis that points up or down", extra={"section": "4.3.4"})],
            write=lambda _target, mounting: commands.set_mounting(LineMounting[mounting.upper()]),
            effect=Effect.AFTER_RESTART,
            readable=False,
        ),
        "baud": Setting(
            type=Annotated[
                BaudRate,
                Meta(
                    description="baud rate of the bus; another rate takes effect after `imud command NAME restart`",
                    extra={"unit": "bit/s", "section": "4.3.2"},
                ),
            ],
            write=lambda _target, baud: commands.set_baud(baud),
            effect=Effect.AFTER_RESTART,
            connection=True,
            bus_rate=True,
            note="the device uses the new rate after its restart; set and save it in all devices of the bus, restart "
            "them with `imud command NAME restart`, then change `rs485.baud` in the configuration",
        ),
        "address": Setting(
            type=Annotated[
                int,
                Meta(
                    ge=1,
                    le=ID_MAX,
                    description="address that is unused on the bus",
                    extra={"section": "4.3.3"},
                ),
            ],
            write=lambda target, address: commands.change_address(commands.places_of(target)[0], address),
            connection=True,
        ),
    },
    read=lambda _target, _names: commands.read_settings(),
    save=lambda _target: commands.save(),
    save_is_certain=False,  # the newest firmware ignores the command
    restart=lambda target: commands.restart(commands.places_of(target), target.baud),
    check=_check,
)


def _example_reading(random: Random) -> bytes:
    quat = random_quaternion(random)
    data = pack_block(
        accel_m_s2=random_vector(random, 9.8), gyro_rad_s=random_vector(random, 2), mag_t=random_vector(random, 5e-5),
        euler_rad=euler312_from_quat(quat), quat_wxyz=quat, temperature_c=random.uniform(-40, 85),
        pressure_pa=random.uniform(80_000, 110_000), uptime_ms=random.randrange(2**32),
    )  # fmt: skip
    return framed(FACTORY_ID, registers_reply(data))


DRIVER: Final = PolledDriver(
    name="hipnuc-modbus",
    title="HiPNUC CH0x0, CH10x, HI14 (RS-485, Modbus RTU)",
    settings=HipnucModbusOptions,
    tick_ns=NS_PER_MS,
    tick_modulus=2**32,
    euler_convention="312: yaw about Z, then pitch about X, then roll about Y; yaw counter-clockwise from above",
    navigation_frame="ENU",
    data_sheet=REGISTERS,
    heading=heading_by_mode,
    link="rs485",
    targets=(FACTORY_ID, *(slave for slave in SLAVES if slave != FACTORY_ID)),
    probe=probe,
    set_up=lambda _options: commands.read_settings(),
    make_codec=HipnucModbusCodec,
    update_ns=update_ns,
    example_reading=_example_reading,
    status_bits=MAIN_STATUS,
    verbs=VERBS,
    renamed=RENAMED,
    device_settings=SETTINGS,
    calibrations=CALIBRATIONS,
)
