"""A Forsense IMU61x on a UART: manual "IMU61X Interface Protocol and Instructions", chapter 1.

The simulator contains no I/O and reads no clock: its owner passes the bytes of the host to `receive` and gets the bytes
of the device from `advance`. Behavior, with assumptions where the manual defines nothing:

- In stream mode, the device sends AHRS frames at 1 to 400 Hz, at whole multiples of the period of its own timer. The
  timer runs `skew_ppm` fast and counts µs from power-on. The device drops frames that do not fit into the transmit
  buffer.
- In command mode, it only replies: to queries with S1, P1 or an AHRS frame, to other commands with K1.
  `Imu61xBehaviour` contains different interpretations of the manual.
- A baud rate applies after its acknowledgement, or after the next start.
- CMD 5 saves all settings with the mode. CMD 9 and a power failure lose unsaved settings. CMD 15 restores the flash
  immediately, and the RAM immediately or after the next start.
- CMD 7 takes some seconds and measures the present attitude. In this time, the result of CMD 8 differs from "done". The
  measured angles can be read but have no effect. CMD 10 takes the same time, subtracts the bias of the gyroscope, and
  is refused while the device moves (all assumptions).
- The heading starts at the truth and is not saved.
- With a layout of raw frames, the stream contains raw frames in place of AHRS frames (layout invented).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from math import degrees, pi, radians, remainder
from typing import Final

from imud.attitude.rotation import euler_zyx_from_quat
from imud.drivers.imu61x.common import FILTER_DEFAULT, I2C_ADDRESSES
from imud.drivers.imu61x.registers import BURST_CTRL
from imud.drivers.imu61x.uart.codec import (
    AHRS_FRAME_BYTES,
    DEVICE_SYNC,
    HOST_SYNC,
    MAG_FRAME_BYTES,
    OVERHEAD_BYTES,
    PARAMETERS,
    RAW_FRAME,
    Frame,
    FrameFinder,
    Parameter,
    Status,
    encode_acknowledgement,
    encode_ahrs,
    encode_frame,
    encode_parameter,
    encode_status,
)
from imud.drivers.imu61x.uart.commands import BAUD_RATES, RATES_HZ, BusMode, Command, OutputMode, max_rate_hz
from imud.drivers.imu61x.uart.raw import RawFrame, pack_raw
from imud.model.ledger import Ledger
from imud.model.sample import Vector3
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US, RAD_PER_DEG
from imud.sim.physics import Truth
from imud.sim.ports.uart_wire import Transmitter
from imud.sim.sensor import Burst, SensorHardware, Simulator, SimulatorOptions, sensor_of

CALIBRATION_NS: Final = 3 * NS_PER_S  # duration of each calibration, ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Imu61xBehaviour:
    """One interpretation of the manual."""

    answers_while_streaming: bool = True  # True: the device processes all commands in stream mode. False: only CMD 3.
    baud_acts_at_start: bool = False  # True: a new baud rate applies after the next start
    reset_acts_at_start: bool = False  # True: CMD 15 changes only the flash and applies after the next start
    changes_mode: bool = True  # True: the device applies the output mode that it acknowledges
    acknowledges: bool = True  # True: the device sends K1
    result_done: int = 0  # result in K1 for a processed command
    result_refused: int = 2  # result in K1 for a refused command
    refuses: frozenset[Command] = frozenset()  # commands that the device refuses with `result_refused`
    ignores: frozenset[Command] = frozenset()  # commands that the device ignores without a reply
    # Time of CMD 5 and CMD 15 until their reply, ms. The device sends and receives no bytes in this time.
    flash_ms: int = 0
    quiet_ms: int = 0  # time after K1 in which the device sends and receives no bytes, ms
    acknowledges_at_end: bool = False  # True: the device sends K1 of a calibration at its end
    whole_status: bool = True  # True: S1 contains all fields


# Commands whose reply is only K1.
ORDERS: Final = frozenset(Command) - {Command.STATUS, Command.AHRS, Command.READ_PARAMETER}

# Simulated variants by name. Each variant processes its commands.
VARIANTS: Final[Mapping[str, Imu61xBehaviour]] = {
    "executes commands while it streams": Imu61xBehaviour(),
    "replies in command mode only": Imu61xBehaviour(answers_while_streaming=False),
    "K1 = 1 means done": Imu61xBehaviour(result_done=1, result_refused=0),
    "no K1": Imu61xBehaviour(acknowledges=False),
    "slow flash": Imu61xBehaviour(flash_ms=2000),
    "quiet after an answer": Imu61xBehaviour(quiet_ms=700),
    "baud rate at the next start": Imu61xBehaviour(baud_acts_at_start=True),
    "factory reset at the next start": Imu61xBehaviour(reset_acts_at_start=True),
    "K1 at the end of a calibration": Imu61xBehaviour(acknowledges_at_end=True),
    "short status": Imu61xBehaviour(whole_status=False),
    "all at once": Imu61xBehaviour(
        answers_while_streaming=False, result_done=1, result_refused=0, flash_ms=2000, quiet_ms=700,
        baud_acts_at_start=True, reset_acts_at_start=True,
    ),
}  # fmt: skip
REFUSING: Final = Imu61xBehaviour(refuses=ORDERS)  # A device that replies to queries and refuses all other commands


@dataclass(frozen=True, slots=True, kw_only=True)
class RegisterBehaviour:
    """One interpretation of chapter 2 of the manual."""

    low_address: bool = True  # True: BURST_CTRL is the high byte of the word at 0x0C, as in the manual
    high_address: bool = True  # True: BURST_CTRL is the low byte of the word at 0x0D, as in the program of the vendor
    window_bits: int = 0  # bits of WIN_CTRL that are set next to WINDOW_ID

    def burst_ctrl(self, address: int, extended: int) -> int:
        """Return the word at 0x0C or 0x0D."""
        if address == BURST_CTRL:
            return extended << 8 if self.low_address else 0
        return extended if self.high_address else 0


# Simulated variants by name.
REGISTER_VARIANTS: Final[Mapping[str, RegisterBehaviour]] = {
    "BURST_CTRL at both addresses": RegisterBehaviour(),
    "BURST_CTRL at 0x0C": RegisterBehaviour(high_address=False),
    "BURST_CTRL at 0x0D": RegisterBehaviour(low_address=False),
    "BURST_CTRL reads zero": RegisterBehaviour(low_address=False, high_address=False),
    "other bits in WIN_CTRL": RegisterBehaviour(window_bits=0xA5FE),
}

GYRO_OFFSETS: Final = (Parameter.GYRO_X_OFF, Parameter.GYRO_Y_OFF, Parameter.GYRO_Z_OFF)
INSTALLATION_ANGLES: Final = (Parameter.INSTALL_X_OFF, Parameter.INSTALL_Y_OFF, Parameter.INSTALL_Z_OFF)


class ParameterRefused(ValueError):
    """An unknown parameter or an invalid value."""


@dataclass(frozen=True, slots=True)
class Imu61xSettings:
    """Settings that CMD 5 saves. The defaults are the defaults of the factory."""

    mode: OutputMode = OutputMode.STREAM
    baud: int = 115_200
    rate_hz: int = 100
    bus_mode: BusMode = BusMode.SPI
    i2c_address: int = I2C_ADDRESSES[0]
    filter_control: int = FILTER_DEFAULT
    gyro_off_deg_s: Vector3 = (0.0, 0.0, 0.0)  # bias that the device subtracts from the angular rate, °/s
    install_off_deg: Vector3 = (0.0, 0.0, 0.0)

    def value(self, index: int) -> float:
        """Return a parameter by its index. Raises ParameterRefused."""
        values: dict[int, float] = {
            Parameter.BAUD: self.baud,
            Parameter.AHRS_RATE: self.rate_hz,
            Parameter.BUS_MODE: self.bus_mode.value,
            Parameter.I2C_ADDRESS: self.i2c_address,
            Parameter.FILTER: self.filter_control,
            **dict(zip(GYRO_OFFSETS, self.gyro_off_deg_s, strict=True)),
            **dict(zip(INSTALLATION_ANGLES, self.install_off_deg, strict=True)),
        }
        if index not in values:
            raise ParameterRefused(f"parameter {index}")
        return values[index]


def changed(settings: Imu61xSettings, index: int, value: float) -> Imu61xSettings:
    """Return the settings after CMD 14. Raises ParameterRefused."""
    factory = Imu61xSettings()
    match index:
        case Parameter.BAUD:
            return replace(settings, baud=int(value) if value in BAUD_RATES else factory.baud)
        case Parameter.AHRS_RATE:
            return replace(settings, rate_hz=int(value) if value in RATES_HZ else factory.rate_hz)
        case Parameter.BUS_MODE if value in [mode.value for mode in BusMode]:
            return replace(settings, bus_mode=BusMode(int(value)))
        case Parameter.I2C_ADDRESS if value in I2C_ADDRESSES:
            return replace(settings, i2c_address=int(value))
        case Parameter.FILTER if 0 <= value <= 0xFF and value == int(value):
            return replace(settings, filter_control=int(value))
    raise ParameterRefused(f"parameter {index} = {value}")


# Maximum number of bytes that wait for the wire. The device drops a frame that exceeds it.
TX_BUFFER_BYTES: Final = 512
REPLY_NS: Final = 200_000  # time from the end of a command to its reply, ns (assumption)
RESULT_BUSY: Final = 9  # result of CMD 8 during a calibration
STATIC_GYRO_RAD_S: Final = 0.02
GYRO_CALIBRATION_SAMPLES: Final = 512
US_PER_S: Final = 1_000_000


# Contents of S1. Model number and units are invented.
STATUS: Final = Status(
    software_version=10203, hardware_version=2, model=614, serial_number=(0x00320047, 0x3133510D, 0x33383736),
    system_status=0, cpu_load=120, drop_rate=0, i2c_master=0, voltage=50, user_config_fault=0,
    calibration_fault=0, imu_health=bytes(32),
)  # fmt: skip


# Layout of the raw frames of `--message RAW`, invented: timer, accelerations in g, angular rates in °/s
RAW_LAYOUT: Final = RawFrame(type="f32", accel_at=4, gyro_at=16, accel_g_per_lsb=1, gyro_deg_s_per_lsb=1, timer_at=0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Imu61xHardware(SensorHardware):
    """A device, and its behavior where the manual defines nothing."""

    status: Status = STATUS
    has_magnetometer: bool = False  # whether AHRS frames have 56 bytes
    raw: RawFrame | None = None  # layout of raw frames; None: the stream contains AHRS frames
    uptime_us: int = 0  # timer at the first power-on, µs, for a start near the end of its range
    behaviour: Imu61xBehaviour = field(default_factory=Imu61xBehaviour)


class Imu61xModule:
    """A simulated device. Its power is on from the start."""

    def __init__(
        self, now_ns: int, settings: Imu61xSettings | None = None, hardware: Imu61xHardware | None = None
    ) -> None:
        """`settings` are the settings in flash."""
        self.hardware = hardware or Imu61xHardware()
        self.flash = self.settings = settings or Imu61xSettings()
        self.epoch_ns = now_ns
        self.frames_sent = 0
        self.frames_dropped = 0  # number of AHRS frames that did not fit into the transmit buffer
        self._scale = NS_PER_S + round(self.hardware.skew_ppm * 1000)  # device ns per 1e9 ns of the host
        self._cut_off: list[Burst] = []
        self._power_on(now_ns, self.hardware.uptime_us)

    @property
    def baud(self) -> int:
        return self._wire.baud

    def reboot(self, now_ns: int) -> None:
        self._sample(now_ns)
        self._cut_off += self._wire.stopped(now_ns)
        self.settings = self.flash
        self._power_on(now_ns, 0)

    def mark(self, now_ns: int) -> None:
        """Do nothing: the device has no sync input."""

    def receive(self, data: bytes, now_ns: int) -> None:
        self._sample(now_ns)
        if now_ns < max(self._ready_ns, self._busy_ns):  # the device starts or writes to flash
            return
        for frame in self._finder.feed(data):
            if isinstance(frame, Frame) and len(frame.payload) == PARAMETERS.size:
                self._obey(frame, now_ns)
            if now_ns < max(self._ready_ns, self._busy_ns):  # a command restarted the device, or takes its time
                return

    def advance(self, now_ns: int) -> list[Burst]:
        self._sample(now_ns)
        done, self._cut_off = self._cut_off, []
        return done + self._wire.sent(now_ns)

    def next_ns(self) -> int | None:
        if self._cut_off:
            return self._cut_off[0].due_ns
        if (due_ns := self._wire.next_ns()) is not None:
            return due_ns
        if self._next_us is None:
            return self._restart_ns
        ready_ns = self._instant_ns(self._next_us) + self.hardware.processing_ns
        return self._wire.due_ns(ready_ns, self._frame_bytes)

    def counters(self) -> dict[str, int]:
        """Return the numbers of sent and dropped frames."""
        return {"frames_sent": self.frames_sent, "frames_dropped": self.frames_dropped}

    # --- time --------------------------------------------------------------------------------------------------------

    def _power_on(self, now_ns: int, uptime_us: int) -> None:
        self._on_ns, self._on_us = now_ns, uptime_us
        self._ready_ns = now_ns + self.hardware.boot_ms * NS_PER_MS
        self._wire = Transmitter(self.settings.baud, TX_BUFFER_BYTES, self._ready_ns)
        self._finder = FrameFinder(Ledger(), HOST_SYNC)
        self._heading_rad = 0.0
        self._calibration: tuple[Command, int] | None = None
        self._busy_ns = now_ns
        self._restart_ns: int | None = None
        self._new_baud_ns: int | None = None
        self._schedule(self._ready_ns)

    def _schedule(self, now_ns: int) -> None:
        """Schedule the next sample after `now_ns` in stream mode."""
        period_us = US_PER_S // self.settings.rate_hz
        streams = self.settings.mode is OutputMode.STREAM
        self._next_us = (self._device_us(now_ns) // period_us + 1) * period_us if streams else None

    def _device_us(self, now_ns: int) -> int:
        """Return the timer without wrap, µs."""
        return self._on_us + (now_ns - self._on_ns) * self._scale // (NS_PER_S * NS_PER_US)

    def _instant_ns(self, device_us: int) -> int:
        """Return the first host time at which the timer is `device_us`."""
        return self._on_ns - (self._on_us - device_us) * NS_PER_US * NS_PER_S // self._scale

    def _sample(self, now_ns: int) -> None:
        """Process all due events: samples, a new baud rate, the end of a calibration, a restart."""
        self._finish_orders(now_ns)
        while self._next_us is not None and (sample_ns := self._instant_ns(self._next_us)) <= now_ns:
            self._queue_ahrs(sample_ns, self._next_us)
            self._next_us += US_PER_S // self.settings.rate_hz

    def _finish_orders(self, now_ns: int) -> None:
        # a rate applies after its acknowledgement was sent and collected
        if self._new_baud_ns is not None and now_ns > self._new_baud_ns and self._wire.next_ns() is None:
            self._new_baud_ns = None
            self._wire = Transmitter(self.settings.baud, TX_BUFFER_BYTES, now_ns)
        if self._calibration is not None and now_ns >= self._calibration[1]:
            self._finish_calibration(*self._calibration)
        if self._restart_ns is not None and now_ns > self._restart_ns and self._wire.next_ns() is None:
            self.settings = self.flash
            self._power_on(self._restart_ns, 0)

    # --- output ------------------------------------------------------------------------------------------------------

    def _queue_ahrs(self, sample_ns: int, device_us: int) -> None:
        ready_ns = sample_ns + self.hardware.processing_ns
        if self._new_baud_ns is not None or self._restart_ns is not None or sample_ns < self._busy_ns:
            self.frames_dropped += 1  # a new baud rate is pending, or the device is busy
            return
        if not self._wire.fits(ready_ns, self._frame_bytes):
            self.frames_dropped += 1
            return
        self.frames_sent += 1
        data = self._encode(sample_ns, device_us, self.hardware.raw)
        self._wire.send(ready_ns, data, sample_ns, device_us // 1000)

    def _encode(self, sample_ns: int, device_us: int, raw: RawFrame | None = None) -> bytes:
        reading = self._reading(sample_ns)
        accel_m_s2 = reading.accel_m_s2
        x, y, z = reading.gyro_rad_s
        off_x, off_y, off_z = (off * RAD_PER_DEG for off in self.settings.gyro_off_deg_s)
        gyro_rad_s = (x - off_x, y - off_y, z - off_z)
        if raw is not None:
            payload = pack_raw(raw, timer_us=device_us, accel_m_s2=accel_m_s2, gyro_rad_s=gyro_rad_s)
            return encode_frame(DEVICE_SYNC, RAW_FRAME, payload)
        roll, pitch, yaw = euler_zyx_from_quat(reading.quat_wxyz)
        return encode_ahrs(
            timer_us=device_us,
            accel_m_s2=accel_m_s2,
            gyro_rad_s=gyro_rad_s,
            euler_rad=(roll, pitch, remainder(yaw + self._heading_rad, 2 * pi)),
            temperature_c=reading.temperature_c,
            mag_t=reading.mag_t if self.hardware.has_magnetometer else None,
        )

    @property
    def _frame_bytes(self) -> int:
        if self.hardware.raw is not None:
            return OVERHEAD_BYTES + self.hardware.raw.size_bytes
        return MAG_FRAME_BYTES if self.hardware.has_magnetometer else AHRS_FRAME_BYTES

    def _reading(self, sample_ns: int) -> Truth:
        """Return the measurement at an instant with noise."""
        return self.hardware.reading((sample_ns - self.epoch_ns) / NS_PER_S)

    def _say(self, data: bytes, now_ns: int) -> None:
        self._wire.send(now_ns + REPLY_NS, data)

    # --- commands ----------------------------------------------------------------------------------------------------

    def _obey(self, frame: Frame, now_ns: int) -> None:
        try:
            command = Command(frame.frame_id)
        except ValueError:
            return
        behaviour = self.hardware.behaviour
        streaming = self.settings.mode is OutputMode.STREAM
        if streaming and command is not Command.OUTPUT_MODE and not behaviour.answers_while_streaming:
            return
        if command in behaviour.ignores:
            return
        param1, _, param3, *_ = PARAMETERS.unpack(frame.payload)
        try:
            if command in behaviour.refuses:
                raise ParameterRefused(command.name)
            answer = self._questions(command, param3, now_ns)
            if answer is not None:
                self._say(answer, now_ns)
                return
            self._order(command, param1, param3, now_ns)
            result = behaviour.result_done
        except ParameterRefused:
            self._acknowledge(command, behaviour.result_refused, now_ns)
            return
        calibrates = command in (Command.CALIBRATE_GYRO, Command.CALIBRATE_INSTALLATION)
        if not (calibrates and behaviour.acknowledges_at_end):
            self._acknowledge(command, result, now_ns)
        self._after(command, now_ns)

    def _acknowledge(self, command: Command, result: int, now_ns: int) -> None:
        """Reply to a command after its duration, then stay silent for `quiet_ms`."""
        behaviour = self.hardware.behaviour
        flash = command in (Command.SAVE, Command.FACTORY_RESET) and result == behaviour.result_done
        done_ns = now_ns + (behaviour.flash_ms if flash else 0) * NS_PER_MS
        if behaviour.acknowledges:
            self._say(encode_acknowledgement(command.value, result), done_ns)
        if behaviour.flash_ms or behaviour.quiet_ms:
            self._busy_ns = max(self._busy_ns, done_ns + behaviour.quiet_ms * NS_PER_MS)

    def _questions(self, command: Command, param3: int, now_ns: int) -> bytes | None:
        """Return the reply to a query; None for other commands. Raises ParameterRefused."""
        match command:
            case Command.STATUS:
                return encode_status(self._status())
            case Command.AHRS:
                return self._encode(now_ns, self._device_us(now_ns))
            case Command.READ_PARAMETER:
                return encode_parameter(param3, self.settings.value(param3))
            case Command.INSTALLATION_STATUS:
                done = self.hardware.behaviour.result_done
                return encode_acknowledgement(command.value, done if self._calibration is None else RESULT_BUSY)
        return None

    def _status(self) -> Status:
        status = self.hardware.status
        return status if self.hardware.behaviour.whole_status else replace(status, system_status=None)

    def _order(self, command: Command, param1: float, param3: int, now_ns: int) -> None:
        """Process a command whose reply is only K1. Raises ParameterRefused."""
        orders: dict[Command, Callable[[], None]] = {
            Command.OUTPUT_MODE: lambda: self._set_mode(param1, now_ns),
            Command.HEADING: lambda: self._set_heading(param1, now_ns),
            Command.SAVE: self._save,
            Command.CALIBRATE_INSTALLATION: lambda: self._calibrate(Command.CALIBRATE_INSTALLATION, now_ns),
            Command.CALIBRATE_GYRO: lambda: self._calibrate(Command.CALIBRATE_GYRO, now_ns),
            Command.SET_PARAMETER: lambda: self._set_parameter(param3, param1, now_ns),
            Command.FACTORY_RESET: lambda: self._factory_reset(now_ns),
            Command.RESTART: lambda: None,
        }
        orders[command]()

    def _after(self, command: Command, now_ns: int) -> None:
        """Process the part of a command that follows its acknowledgement."""
        if command is Command.RESTART:
            self._next_us = None
            self._restart_ns = self._wire.due_ns(now_ns, 0)
        elif self.settings.baud != self._wire.baud and not self.hardware.behaviour.baud_acts_at_start:
            self._new_baud_ns = self._wire.due_ns(now_ns, 0)

    def _set_mode(self, mode: float, now_ns: int) -> None:
        if mode not in [known.value for known in OutputMode]:
            raise ParameterRefused(f"mode {mode}")
        if self.hardware.behaviour.changes_mode:
            self.settings = replace(self.settings, mode=OutputMode(int(mode)))
        self._schedule(now_ns)

    def _set_heading(self, heading_deg: float, now_ns: int) -> None:
        if not 0 <= heading_deg <= 360:  # also refuses NaN
            raise ParameterRefused(f"heading {heading_deg}")
        self._heading_rad = radians(heading_deg) - euler_zyx_from_quat(self._reading(now_ns).quat_wxyz)[2]

    def _save(self) -> None:
        """Save all settings, without command mode if CMD 5 works only in this mode: it would never stream again."""
        keeps_mode = self.hardware.behaviour.answers_while_streaming
        self.flash = self.settings if keeps_mode else replace(self.settings, mode=self.flash.mode)

    def _set_parameter(self, index: int, value: float, now_ns: int) -> None:
        self.settings = changed(self.settings, index, value)
        self._schedule(now_ns)

    def _factory_reset(self, now_ns: int) -> None:
        self.flash = Imu61xSettings()
        if not self.hardware.behaviour.reset_acts_at_start:
            self.settings = self.flash
        self._schedule(now_ns)

    def _calibrate(self, command: Command, now_ns: int) -> None:
        moving = max(map(abs, self.hardware.motion.at((now_ns - self.epoch_ns) / NS_PER_S).gyro_rad_s))
        if command is Command.CALIBRATE_GYRO and moving > STATIC_GYRO_RAD_S:
            raise ParameterRefused("moving")
        self._calibration = (command, now_ns + CALIBRATION_NS)

    def _finish_calibration(self, command: Command, done_ns: int) -> None:
        self._calibration = None
        if command is Command.CALIBRATE_GYRO:
            readings = [self._reading(done_ns).gyro_rad_s for _ in range(GYRO_CALIBRATION_SAMPLES)]
            x, y, z = (degrees(sum(axis) / len(readings)) for axis in zip(*readings, strict=True))
            self.settings = replace(self.settings, gyro_off_deg_s=(x, y, z))
        else:
            roll, pitch, _ = euler_zyx_from_quat(self._reading(done_ns).quat_wxyz)
            self.settings = replace(self.settings, install_off_deg=(degrees(roll), degrees(pitch), 0.0))
        if self.hardware.behaviour.acknowledges_at_end:
            self._acknowledge(command, self.hardware.behaviour.result_done, done_ns)


def make(options: SimulatorOptions, now_ns: int) -> Imu61xModule:
    """Return a device for the options. Raises ValueError for an unsupported option."""
    if options.rate_hz not in RATES_HZ:
        raise ValueError(f"rate {options.rate_hz:g} Hz: expected one of {', '.join(map(str, RATES_HZ))}")
    if options.message.upper() not in ("", "AHRS", "AHRS9", "RAW"):
        raise ValueError(f"message {options.message!r}: expected AHRS, AHRS9 with the magnetic field, or RAW")
    rate_hz = int(options.rate_hz)
    baud = options.baud or next(baud for baud in sorted(BAUD_RATES) if max_rate_hz(baud) >= rate_hz)
    if baud not in BAUD_RATES:
        raise ValueError(f"baud {baud}: expected one of {', '.join(map(str, sorted(BAUD_RATES)))}")
    hardware = Imu61xHardware(
        status=replace(STATUS, software_version=options.firmware or STATUS.software_version),
        **sensor_of(options),
        has_magnetometer=options.message.upper() == "AHRS9",
        raw=RAW_LAYOUT if options.message.upper() == "RAW" else None,
        behaviour=options.chosen(VARIANTS),
    )
    return Imu61xModule(now_ns, Imu61xSettings(baud=baud, rate_hz=rate_hz), hardware)


SIMULATOR = Simulator("imu61x-uart", "Forsense IMU614 (IMU61x) on a UART", make)
