"""A Forsense IMU61x at the far end of a UART: manual "IMU61X Interface Protocol and Instructions", chapter 1.

Without I/O and without a clock of its own: the owner passes what the host sent to `receive` and collects what the
device sent with `advance`. What it does, and what of it is assumed because the manual is silent:

- In stream mode it sends AHRS frames at 1 … 400 Hz, at whole multiples of the period of its own timer, which runs
  `skew_ppm` fast and counts µs from power-on. What does not fit the transmit buffer is never sent.
- In command mode it only replies. Whether it also replies while it streams is assumed (`Imu61xHardware`).
- Questions are answered with S1, P1 or an AHRS frame, orders with K1: result 0 done, 1 refused (assumed).
- A baud rate acts once its acknowledgement has left the wire, or at the next start (`Imu61xHardware`; assumed).
- CMD 5 saves everything, the mode included. CMD 9 and power-off lose what was not saved. CMD 15 restores RAM and flash.
- CMD 7 takes some seconds and finds the attitude it stands in; CMD 8 says 1 until it is done, then 0. The angles found
  can be read but turn nothing. CMD 10 takes the gyroscope's bias off and is refused while it moves (all assumed).
- Heading starts as the truth has it and is not saved.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import degrees, pi, radians, remainder
from typing import Final

from imud.attitude import euler_zyx_from_quat
from imud.devices.imu61x.uart.codec import encode_acknowledgement, encode_ahrs, encode_parameter, encode_status
from imud.devices.imu61x.uart.commands import AHRS_FRAME_BYTES, BAUD_RATES, RATES_HZ, Command, OutputMode, max_rate_hz
from imud.devices.imu61x.uart.framing import HOST_SYNC, Frame, FrameFinder
from imud.devices.imu61x.uart.replies import PARAMETERS, RESULT_DONE, Status
from imud.ledger import Ledger
from imud.sample import Vector3
from imud.sim.imu61x.settings import Imu61xSettings, ParameterRefused, changed
from imud.sim.physics.motion import Truth
from imud.sim.ports.uart_wire import Transmitter
from imud.sim.sensor import SensorHardware, sensor_of
from imud.sim.simulator import Burst, Simulator, SimulatorOptions
from imud.units import NS_PER_MS, NS_PER_S, NS_PER_US, RAD_PER_DEG

TX_BUFFER_BYTES: Final = 512
"""A frame that would make more than this wait for the wire is not sent."""
REPLY_NS: Final = 200_000
"""Time from the end of a command to its reply (assumed)."""
CALIBRATION_NS: Final = 3 * NS_PER_S
RESULT_REFUSED: Final = 1
CALIBRATING: Final = 1
STATIC_GYRO_RAD_S: Final = 0.02
GYRO_CALIBRATION_SAMPLES: Final = 64
US_PER_S: Final = 1_000_000


STATUS: Final = Status(
    software_version=10203, hardware_version=2, model=614, serial_number=(0x00320047, 0x3133510D, 0x33383736),
    system_status=0, cpu_load=120, drop_rate=0, i2c_master=0, voltage=50, user_config_status=0,
    calibration_status=0, imu_health=bytes(32),
)  # fmt: skip
"""Contents of S1; model number and units are made up."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Imu61xHardware(SensorHardware):
    """A device, and its assumed behaviour where the manual is silent."""

    status: Status = STATUS
    uptime_us: int = 0
    """Timer at the first power-on, to begin near the end of its range."""
    answers_while_streaming: bool = True
    """Whether it obeys more than CMD 3 in stream mode."""
    baud_acts_at_start: bool = False
    """Whether a new baud rate waits for the next start."""
    changes_mode: bool = True
    """Whether it obeys the output mode it acknowledges."""
    acknowledges: bool = True
    """Whether it sends K1 at all."""


class Imu61xModule:
    """A simulated device, powered on from construction."""

    def __init__(
        self, now_ns: int, settings: Imu61xSettings | None = None, hardware: Imu61xHardware | None = None
    ) -> None:
        """`settings` are what its flash holds."""
        self.hardware = hardware or Imu61xHardware()
        self.flash = self.settings = settings or Imu61xSettings()
        self.epoch_ns = now_ns
        self.frames_sent = 0
        self.frames_dropped = 0
        """AHRS frames that did not fit the wire."""
        self._scale = NS_PER_S + round(self.hardware.skew_ppm * 1000)  # device ns per 1e9 ns of the host
        self._cut_off: list[Burst] = []
        self._power_on(now_ns, self.hardware.uptime_us)

    @property
    def baud(self) -> int:
        """Rate in bit/s in force."""
        return self._wire.baud

    def reboot(self, now_ns: int) -> None:
        """Restart after a loss of power: unsaved settings are lost."""
        self._sample(now_ns)
        self._cut_off += self._wire.stopped(now_ns)
        self.settings = self.flash
        self._power_on(now_ns, 0)

    def mark(self, now_ns: int) -> None:
        """No-op: the device has no sync input."""

    def receive(self, data: bytes, now_ns: int) -> None:
        """Receive bytes that the host sent, already sampled at the device's rate."""
        self._sample(now_ns)
        if now_ns < self._ready_ns:  # still booting
            return
        for frame in self._finder.feed(data):
            if isinstance(frame, Frame) and len(frame.payload) == PARAMETERS.size:
                self._obey(frame, now_ns)
            if now_ns < self._ready_ns:  # a command restarted it
                return

    def advance(self, now_ns: int) -> list[Burst]:
        """Return what has left the wire since the last call, in order."""
        self._sample(now_ns)
        done, self._cut_off = self._cut_off, []
        return done + self._wire.sent(now_ns)

    def next_ns(self) -> int | None:
        """Time of the next output of `advance`; None for none."""
        if self._cut_off:
            return self._cut_off[0].due_ns
        if (due_ns := self._wire.next_ns()) is not None:
            return due_ns
        if self._next_us is None:
            return self._restart_ns
        ready_ns = self._instant_ns(self._next_us) + self.hardware.processing_ns
        return self._wire.due_ns(ready_ns, AHRS_FRAME_BYTES)

    def counters(self) -> dict[str, int]:
        """Counters of frames by their fate."""
        return {"frames_sent": self.frames_sent, "frames_dropped": self.frames_dropped}

    # --- time --------------------------------------------------------------------------------------------------------

    def _power_on(self, now_ns: int, uptime_us: int) -> None:
        self._on_ns, self._on_us = now_ns, uptime_us
        self._ready_ns = now_ns + self.hardware.boot_ms * NS_PER_MS
        self._wire = Transmitter(self.settings.baud, TX_BUFFER_BYTES, self._ready_ns)
        self._finder = FrameFinder(Ledger(), HOST_SYNC)
        self._heading_rad = 0.0
        self._calibrated_ns: int | None = None
        self._restart_ns: int | None = None
        self._new_baud_ns: int | None = None
        self._schedule(self._ready_ns)

    def _schedule(self, now_ns: int) -> None:
        """The next sample after `now_ns`, if it streams."""
        period_us = US_PER_S // self.settings.rate_hz
        streams = self.settings.mode is OutputMode.STREAM
        self._next_us = (self._device_us(now_ns) // period_us + 1) * period_us if streams else None

    def _device_us(self, now_ns: int) -> int:
        """The timer, not wrapped."""
        return self._on_us + (now_ns - self._on_ns) * self._scale // (NS_PER_S * NS_PER_US)

    def _instant_ns(self, device_us: int) -> int:
        """First host time at which the timer shows `device_us`."""
        return self._on_ns - (self._on_us - device_us) * NS_PER_US * NS_PER_S // self._scale

    def _sample(self, now_ns: int) -> None:
        """Do all that is due: samples, a new baud rate, the end of a calibration, a restart."""
        self._finish_orders(now_ns)
        while self._next_us is not None and (sample_ns := self._instant_ns(self._next_us)) <= now_ns:
            self._queue_ahrs(sample_ns, self._next_us)
            self._next_us += US_PER_S // self.settings.rate_hz

    def _finish_orders(self, now_ns: int) -> None:
        # a rate acts when its acknowledgement has left and was collected, which no caller puts off for long
        if self._new_baud_ns is not None and now_ns > self._new_baud_ns and self._wire.next_ns() is None:
            self._new_baud_ns = None
            self._wire = Transmitter(self.settings.baud, TX_BUFFER_BYTES, now_ns)
        if self._calibrated_ns is not None and now_ns >= self._calibrated_ns:
            self._finish_installation(self._calibrated_ns)
        if self._restart_ns is not None and now_ns > self._restart_ns and self._wire.next_ns() is None:
            self.settings = self.flash
            self._power_on(self._restart_ns, 0)

    # --- output ------------------------------------------------------------------------------------------------------

    def _queue_ahrs(self, sample_ns: int, device_us: int) -> None:
        ready_ns = sample_ns + self.hardware.processing_ns
        if self._new_baud_ns is not None or self._restart_ns is not None:
            self.frames_dropped += 1  # the port is being set up anew
            return
        if not self._wire.fits(ready_ns, AHRS_FRAME_BYTES):
            self.frames_dropped += 1
            return
        self.frames_sent += 1
        self._wire.send(ready_ns, self._encode(sample_ns, device_us), sample_ns, device_us // 1000)

    def _encode(self, sample_ns: int, device_us: int) -> bytes:
        reading = self._reading(sample_ns)
        roll, pitch, yaw = euler_zyx_from_quat(reading.quat_wxyz)
        x, y, z = reading.gyro_rad_s
        off_x, off_y, off_z = (off * RAD_PER_DEG for off in self.settings.gyro_off_deg_s)
        return encode_ahrs(
            timer_us=device_us,
            accel_m_s2=reading.accel_m_s2,
            gyro_rad_s=(x - off_x, y - off_y, z - off_z),
            euler_rad=(roll, pitch, remainder(yaw + self._heading_rad, 2 * pi)),
            temperature_c=reading.temperature_c,
        )

    def _reading(self, sample_ns: int) -> Truth:
        """Return the measurement at an instant, noise included."""
        return self.hardware.reading((sample_ns - self.epoch_ns) / NS_PER_S)

    def _say(self, data: bytes, now_ns: int) -> None:
        self._wire.send(now_ns + REPLY_NS, data)

    # --- commands ----------------------------------------------------------------------------------------------------

    def _obey(self, frame: Frame, now_ns: int) -> None:
        try:
            command = Command(frame.frame_id)
        except ValueError:
            return
        streaming = self.settings.mode is OutputMode.STREAM
        if streaming and command is not Command.OUTPUT_MODE and not self.hardware.answers_while_streaming:
            return
        param1, _, param3, *_ = PARAMETERS.unpack(frame.payload)
        try:
            answer = self._questions(command, param3, now_ns)
            if answer is not None:
                self._say(answer, now_ns)
                return
            self._order(command, param1, param3, now_ns)
            result = RESULT_DONE
        except ParameterRefused:
            result = RESULT_REFUSED
        if self.hardware.acknowledges:
            self._say(encode_acknowledgement(frame.frame_id, result), now_ns)
        self._after(command, now_ns)

    def _questions(self, command: Command, param3: int, now_ns: int) -> bytes | None:
        """The answer to a question; None for an order. Raises ParameterRefused."""
        match command:
            case Command.STATUS:
                return encode_status(replace(self.hardware.status, calibration_status=self._calibration_status()))
            case Command.AHRS:
                return self._encode(now_ns, self._device_us(now_ns))
            case Command.READ_PARAMETER:
                return encode_parameter(param3, self.settings.value(param3))
            case Command.INSTALLATION_STATUS:
                return encode_acknowledgement(command.value, self._calibration_status())
        return None

    def _calibration_status(self) -> int:
        return RESULT_DONE if self._calibrated_ns is None else CALIBRATING

    def _order(self, command: Command, param1: float, param3: int, now_ns: int) -> None:
        """Carry out a command without an answer of its own. Raises ParameterRefused."""
        orders: dict[Command, Callable[[], None]] = {
            Command.OUTPUT_MODE: lambda: self._set_mode(param1, now_ns),
            Command.HEADING: lambda: self._set_heading(param1, now_ns),
            Command.SAVE: self._save,
            Command.CALIBRATE_INSTALLATION: lambda: self._start_installation(now_ns),
            Command.CALIBRATE_GYRO: lambda: self._calibrate_gyro(now_ns),
            Command.SET_PARAMETER: lambda: self._set_parameter(param3, param1, now_ns),
            Command.FACTORY_RESET: lambda: self._factory_reset(now_ns),
            Command.RESTART: lambda: None,
        }
        orders[command]()

    def _after(self, command: Command, now_ns: int) -> None:
        """Carry out what is postponed until the acknowledgement has left."""
        if command is Command.RESTART:
            self._next_us = None
            self._restart_ns = self._wire.due_ns(now_ns, 0)
        elif self.settings.baud != self._wire.baud and not self.hardware.baud_acts_at_start:
            self._new_baud_ns = self._wire.due_ns(now_ns, 0)

    def _set_mode(self, mode: float, now_ns: int) -> None:
        if mode not in [known.value for known in OutputMode]:
            raise ParameterRefused(f"mode {mode}")
        if self.hardware.changes_mode:
            self.settings = replace(self.settings, mode=OutputMode(int(mode)))
        self._schedule(now_ns)

    def _set_heading(self, heading_deg: float, now_ns: int) -> None:
        if not 0 <= heading_deg <= 360:  # NaN is refused too
            raise ParameterRefused(f"heading {heading_deg}")
        self._heading_rad = radians(heading_deg) - euler_zyx_from_quat(self._reading(now_ns).quat_wxyz)[2]

    def _save(self) -> None:
        """Save all but command mode where CMD 5 is obeyed in that only: the device would never start streaming."""
        keeps_mode = self.hardware.answers_while_streaming
        self.flash = self.settings if keeps_mode else replace(self.settings, mode=self.flash.mode)

    def _set_parameter(self, index: int, value: float, now_ns: int) -> None:
        self.settings = changed(self.settings, index, value)
        self._schedule(now_ns)

    def _factory_reset(self, now_ns: int) -> None:
        self.flash = self.settings = Imu61xSettings()
        self._schedule(now_ns)

    def _calibrate_gyro(self, now_ns: int) -> None:
        if max(map(abs, self.hardware.motion.at((now_ns - self.epoch_ns) / NS_PER_S).gyro_rad_s)) > STATIC_GYRO_RAD_S:
            raise ParameterRefused("moving")
        readings = [self._reading(now_ns).gyro_rad_s for _ in range(GYRO_CALIBRATION_SAMPLES)]
        x, y, z = (degrees(sum(axis) / len(readings)) for axis in zip(*readings, strict=True))
        self.settings = replace(self.settings, gyro_off_deg_s=(x, y, z))

    def _start_installation(self, now_ns: int) -> None:
        self._calibrated_ns = now_ns + CALIBRATION_NS

    def _finish_installation(self, done_ns: int) -> None:
        self._calibrated_ns = None
        roll, pitch, _ = euler_zyx_from_quat(self._reading(done_ns).quat_wxyz)
        angles: Vector3 = (degrees(roll), degrees(pitch), 0.0)
        self.settings = replace(self.settings, install_off_deg=angles)


def make(options: SimulatorOptions, now_ns: int) -> Imu61xModule:
    """A device from the common options. Raises ValueError naming the option that it cannot have."""
    if options.rate_hz not in RATES_HZ:
        raise ValueError(f"rate {options.rate_hz:g} Hz: expected one of {', '.join(map(str, RATES_HZ))}")
    if options.message.upper() not in ("", "AHRS"):
        raise ValueError(f"message {options.message!r}: expected AHRS")
    rate_hz = int(options.rate_hz)
    baud = options.baud or next(baud for baud in sorted(BAUD_RATES) if max_rate_hz(baud) >= rate_hz)
    if baud not in BAUD_RATES:
        raise ValueError(f"baud {baud}: expected one of {', '.join(map(str, sorted(BAUD_RATES)))}")
    hardware = Imu61xHardware(
        status=replace(STATUS, software_version=options.firmware or STATUS.software_version),
        **sensor_of(options),
    )
    return Imu61xModule(now_ns, Imu61xSettings(baud=baud, rate_hz=rate_hz), hardware)


SIMULATOR = Simulator("imu61x-uart", "Forsense IMU614 (IMU61x) on a UART", make)
