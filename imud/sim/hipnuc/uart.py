"""A HiPNUC device (CH0x0, CH10x, HI14) on a UART: IMU configuration manual V1.5.9, chapters 1-3, 8.

The simulator contains no I/O and reads no clock: its owner passes the bytes of the host to `receive` and gets the bytes
of the device from `advance`. It behaves as a real device:

- It samples at whole milliseconds of its own crystal, which runs `skew_ppm` fast. `system_time` counts from power-on.
- A frame leaves `processing_ns` after its sample, when the wire is free. Text is sent between complete frames. The
  device drops a frame that does not fit into the transmit buffer: at 115200 baud and 1 kHz it drops six of seven
  frames.
- Commands are lines of ASCII, processed immediately. The reply to a known command is `OK` or `ERR`; an unknown command
  has no reply. URFR acts only after SAVECONFIG and REBOOT. A restart loses unsaved settings. The device never saves
  YAW. The class `Behaviour` contains the moments at which SERIALCONFIG and FRESET act, and other behavior that the
  manual does not define.
- SOUT has a pulse before each frame. A rising edge on SIN sends the messages that are set to ONMARK. `pins` returns
  edges as `advance` returns bytes.
- AT+RST restarts the device into its boot loader (`boot_loader.py`), which starts the application after a short time.
- LOG DISABLE stops frames, not replies. It ends at a restart (assumption: the manual calls ENABLE the default).

The attitude is the truth in both modes. In six-axis mode, the heading of a real device starts at zero; here it does
not.
"""

from bisect import bisect_right, insort
from collections.abc import Callable
from dataclasses import replace
from math import degrees, pi, radians
from random import Random
from typing import Any, Final

from imud.drivers.hipnuc.uart.codec import encode_hi91, encode_hi92
from imud.drivers.hipnuc.uart.commands import BAUD_RATES, FRAME_BYTES, MAX_RATE_HZ, OutputMessage
from imud.drivers.hipnuc.uart.ins import hi83_size
from imud.formats.nmea0183 import sentence
from imud.model.sample import Vector3
from imud.model.units import NS_PER_MS, NS_PER_S, NS_PER_US, T_PER_UT
from imud.sim.hipnuc.boot_loader import Application, Flash, KbootLoader
from imud.sim.hipnuc.ins import encode_ins
from imud.sim.hipnuc.uart_settings import (
    NWU,
    VARIANTS,
    CommandRefused,
    HipnucHardware,
    ModuleSettings,
    Output,
    RateChange,
    ResetEffect,
    SelfCalibration,
    UtcTime,
    changed,
    in_nwu,
    main_status,
    number,
    rows,
)
from imud.sim.physics import MountingRotation, Truth, frame_of, level_of
from imud.sim.ports.uart_wire import Transmitter
from imud.sim.sensor import Burst, Pin, PinEdge, Simulator, SimulatorOptions, sensor_of

SOUT_HIGH_NS: Final = 80 * NS_PER_US
ALARM_PERIOD_MS: Final = 10
EDGES_MAX: Final = 8192  # Maximum number of stored edges. The newest edges stay if the owner does not collect them.


class HipnucPins:
    """Pending edges and current levels. Synchronization: one thread."""

    def __init__(self) -> None:
        self._waiting: list[PinEdge] = []
        self._alarm = False  # level of ALARM after all pending edges
        self._pulses = 0  # number of SOUT pulses since the last pulse of SOUT_DIV

    def restart_divider(self) -> None:
        """Restart the counter of the divider after a change of its setting."""
        self._pulses = 0

    def frame(self, start_ns: int, high_ns: int, divider: int, sample_ns: int) -> None:
        """Schedule a pulse of `high_ns` before a frame that starts on the wire at `start_ns`."""
        pins = [Pin.SOUT]
        self._pulses += 1
        if self._pulses >= divider:
            self._pulses = 0
            pins.append(Pin.SOUT_DIV)
        for pin in pins:
            self._add(PinEdge(start_ns - high_ns, pin, True, sample_ns))
            self._add(PinEdge(start_ns, pin, False, sample_ns))

    def alarm(self, at_ns: int, active: bool) -> None:
        """Set the level of ALARM at `at_ns`."""
        if active != self._alarm:
            self._alarm = active
            self._add(PinEdge(at_ns, Pin.ALARM, active))

    def edges(self, now_ns: int) -> list[PinEdge]:
        """Return and remove the edges up to now."""
        count = bisect_right(self._waiting, now_ns, key=_due_ns)
        done, self._waiting = self._waiting[:count], self._waiting[count:]
        return done

    def next_ns(self) -> int | None:
        """Return the time of the next scheduled edge; None if there is none."""
        return self._waiting[0].due_ns if self._waiting else None

    def power_lost(self, now_ns: int) -> None:
        """Cancel pending edges. High pins become low."""
        count = bisect_right(self._waiting, now_ns, key=_due_ns)
        dropped = self._waiting[count:]
        del self._waiting[count:]
        self._pulses = 0
        first_dropped = {edge.pin: edge for edge in reversed(dropped)}
        for pin in Pin:
            dropped_edge = first_dropped.get(pin)
            high = not dropped_edge.rising if dropped_edge else pin is Pin.ALARM and self._alarm
            if high:
                self._add(PinEdge(now_ns, pin, False))
        self._alarm = False

    def _add(self, edge: PinEdge) -> None:
        if len(self._waiting) >= EDGES_MAX:
            del self._waiting[: EDGES_MAX // 2]
        insort(self._waiting, edge, key=_due_ns)


def is_alarming(settings: ModuleSettings, euler_rad: Vector3) -> bool:
    """Return whether an angle is outside the range of PMUX5."""
    roll, pitch, _ = euler_rad
    return any(
        alarm.enabled and not alarm.low_deg <= degrees(angle_rad) <= alarm.high_deg
        for alarm, angle_rad in ((settings.alarm_x, pitch), (settings.alarm_y, roll))
    )


def _due_ns(edge: PinEdge) -> int:
    return edge.due_ns


FACTORY_BAUD: Final = ModuleSettings().baud
MAIN_STATUS_FIRMWARE: Final = 169  # firmware since which HI91 bytes 1-2 are MAIN_STATUS and not the PPS time
# Maximum number of bytes that wait for the wire. The device drops a frame that exceeds it.
TX_BUFFER_BYTES: Final = 512
# Maximum length of a command, bytes (assumption). The longest command of the manual, URFR, has 123 with nine decimals.
COMMAND_BYTES_MAX: Final = 128
LOADER_NS: Final = 5 * NS_PER_MS  # time from a restart until the boot loader receives bytes, ns (assumption)
REPLY_NS: Final = 200_000  # time from the end of a command to its reply, ns (assumption)
# Commands of newer firmware without OK: a frame is the reply, or the device restarts
WITHOUT_OK: Final = ("REBOOT", "LOG IMU91 ONMARK ONCE", "LOG HI91 ONMARK ONCE", "LOG HI92 ONMARK ONCE")
WRITES_FLASH: Final = ("SAVECONFIG", "FRESET")
# Time from a reply to the change of the baud rate, ns, if the change follows the reply (assumption).
RATE_CHANGE_NS: Final = 5 * NS_PER_MS
PPS_MODULUS_MS: Final = 8192  # Modulus of the PPS time without edges, ms. A recording shows 0 to 8191.
NEAR_LEVEL_RAD: Final = radians(5)  # maximum tilt at which ATT RST 3 acts, rad
_PRINTABLE = range(0x20, 0x7F)
INS_FIRMWARE: Final = 170  # default firmware of a device with HI81 or HI83


class HipnucModule:
    """A simulated device. Its power is on from the start."""

    def __init__(
        self, now_ns: int, settings: ModuleSettings | None = None, hardware: HipnucHardware | None = None
    ) -> None:
        """`settings` are the settings in flash."""
        self.hardware = hardware or HipnucHardware()
        self.flash = self.settings = settings or ModuleSettings()
        self.epoch_ns = now_ns
        self.frames_sent = 0
        self.frames_dropped = 0  # number of frames that did not fit into the transmit buffer
        self._scale = NS_PER_S + round(self.hardware.skew_ppm * 1000)  # device ns per 1e9 ns of the host
        self._before_reboot: list[Burst] = []
        self._pins = HipnucPins()
        self._random = Random(self.hardware.mark_seed)
        self._line = bytearray()
        self._lost_replies = set(self.hardware.behaviour.loses)
        self._magnetometer = SelfCalibration(
            self.hardware.hard_iron_t, self.hardware.mag_bias_t, self.hardware.behaviour.calibration
        )
        self.memory = Flash(Application(self.hardware.product, self.hardware.firmware))
        self.loader: KbootLoader | None = None  # active boot loader; None while the application runs
        self._actions = self._make_actions()
        self._power_on(now_ns, self.hardware.uptime_ms)

    @property
    def baud(self) -> int:
        return self._wire.baud

    def reboot(self, now_ns: int) -> None:
        """Restart after REBOOT or a power failure. The device loses unsaved settings."""
        self._restart(now_ns, waits=False)

    def _restart(self, now_ns: int, *, waits: bool) -> None:
        """Restart the device. `waits`: the boot loader waits for a ping before it starts the application."""
        self._sample(now_ns)
        self._before_reboot += self._wire.stopped(now_ns)
        self._pins.power_lost(now_ns)
        self.settings = self.flash
        self._power_on(now_ns, 0, waits=waits)

    def receive(self, data: bytes, now_ns: int) -> None:
        self._sample(now_ns)
        if now_ns < self._ready_ns:  # the device still starts
            return
        if self.loader is not None:
            for reply in self.loader.receive(data, now_ns):
                self._wire.send(now_ns + REPLY_NS, reply)
            if self.loader.wants_reset:
                self._restart_after_reply(now_ns)
            return
        for byte in data:
            if byte == 0x0A:
                line, self._line = self._line, bytearray()
                if len(line) <= COMMAND_BYTES_MAX:
                    self._obey(line.decode("ascii"), now_ns)
                if now_ns < self._ready_ns:  # the command was REBOOT
                    return
            elif byte in _PRINTABLE:
                if len(self._line) <= COMMAND_BYTES_MAX:
                    self._line.append(byte)
            elif byte != 0x0D:
                self._line.clear()

    def _restart_after_reply(self, now_ns: int) -> None:
        """Restart when the pending replies of the boot loader have left the wire."""
        sent = self._wire.sent(self._wire.due_ns(now_ns, 0))
        self._restart(now_ns, waits=False)
        self._before_reboot += sent

    def mark(self, now_ns: int) -> None:
        """Process a rising edge on SIN/PPS: restart the PPS time and send the messages that are set to ONMARK."""
        self._sample(now_ns)
        if now_ns < self._ready_ns:  # the device still starts
            return
        self._pps_ns = self._device_ns(now_ns)
        self._utc.pulse(self._pps_ns)
        for message in self._outputs:
            self._send_marked(message, now_ns)

    def advance(self, now_ns: int) -> list[Burst]:
        self._sample(now_ns)
        before = [burst for burst in self._before_reboot if burst.due_ns <= now_ns]
        self._before_reboot = self._before_reboot[len(before) :]
        return before + self._wire.sent(now_ns)

    def next_ns(self) -> int | None:
        if self._before_reboot:
            return self._before_reboot[0].due_ns
        if self.loader is not None and self._wire.next_ns() is None:
            return self.loader.until_ns
        if (due_ns := self._wire.next_ns()) is not None or not self._next_ms:
            return due_ns
        message, device_ms = min(self._next_ms.items(), key=lambda item: item[1])
        ready_ns = self._instant_ns(device_ms) + self.hardware.processing_ns
        return self._wire.due_ns(ready_ns, self._frame_bytes(message))

    def pins(self, now_ns: int) -> list[PinEdge]:
        """Return the edges on the output pins since the last call, in order."""
        self._sample(now_ns)
        return self._pins.edges(now_ns)

    def next_pin_ns(self) -> int | None:
        """Return the time of the next edge of `pins`; None if no edge is due."""
        times = [] if (next_ns := self._pins.next_ns()) is None else [next_ns]
        if self._next_ms:
            times.append(self._instant_ns(min(self._next_ms.values())))
        if self._alarm_ms is not None:
            times.append(self._instant_ns(self._alarm_ms))
        return min(times, default=None)

    def counters(self) -> dict[str, int]:
        """Return the numbers of sent and dropped frames."""
        return {"frames_sent": self.frames_sent, "frames_dropped": self.frames_dropped}

    def _power_on(self, now_ns: int, uptime_ms: int, *, waits: bool = False) -> None:
        settings, application = self.settings, self.memory.application(self.hardware.product)
        if application is not None and application.version != self.hardware.firmware:
            self.hardware = replace(self.hardware, firmware=application.version)
            if baud := self.hardware.baud_after_update:
                self.flash = self.settings = settings = replace(settings, baud=baud)
            self._actions = self._make_actions()
        hardware, self.loader = self.hardware, None
        if application is None or waits:
            version = 0 if application is None else application.version
            self.loader = KbootLoader(self.memory, now_ns, hardware.bootloader, version)
            if application is None:
                self.loader.until_ns = None
        self._frame = frame_of(rows(settings.urfr))
        self._yaw_rad = 0.0
        self._on_ns, self._on_ms = now_ns, uptime_ms
        self._calibrates = False  # whether a command has started a calibration of the magnetometer
        self._ready_ns = now_ns + (hardware.boot_ms * NS_PER_MS if self.loader is None else LOADER_NS)
        self._wire = Transmitter(settings.baud, TX_BUFFER_BYTES, self._ready_ns)
        self._rate_at_ns = self._quiet_until_ns = 0
        self._pps_ns = 0
        self._utc = UtcTime(hardware.utc_epoch, wraps_daily=hardware.behaviour.newer)
        self._enabled = self.loader is None
        self._line.clear()
        self._settings_changed(self._ready_ns)

    def _settings_changed(self, now_ns: int) -> None:
        """Schedule the messages after `now_ns` and apply the rotations of the attitude."""
        settings, device_ms = self.settings, self._device_ms(now_ns)
        self._outputs: dict[OutputMessage, Output] = {one: getattr(settings, one.lower()) for one in OutputMessage}
        self._mounting = MountingRotation(self._frame, settings.level, settings.level_accel, self._yaw_rad)
        watching = (settings.alarm_x.enabled or settings.alarm_y.enabled) and self.loader is None
        self._alarm_ms = (device_ms // ALARM_PERIOD_MS + 1) * ALARM_PERIOD_MS if watching else None
        if not watching:
            self._pins.alarm(now_ns, False)
        self._next_ms: dict[OutputMessage, int] = {}
        for message, output in self._outputs.items():
            if output.period_ms and self._enabled:
                self._next_ms[message] = (device_ms // output.period_ms + 1) * output.period_ms

    def _device_ms(self, now_ns: int) -> int:
        """Return the device time without wrap, ms."""
        return self._device_ns(now_ns) // NS_PER_MS

    def _device_ns(self, now_ns: int) -> int:
        return self._on_ms * NS_PER_MS + (now_ns - self._on_ns) * self._scale // NS_PER_S

    def _instant_ns(self, device_ms: int) -> int:
        """Return the first host time at which the device time is `device_ms`."""
        return self._on_ns - (self._on_ms - device_ms) * NS_PER_MS * NS_PER_S // self._scale

    def _sample(self, now_ns: int) -> None:
        """Sample up to now and queue the frames. Check the angles for ALARM at its interval."""
        if self.loader is not None and self.loader.until_ns is not None and now_ns >= self.loader.until_ns:
            at_ns, self.loader.until_ns = self.loader.until_ns, None
            self._restart(at_ns, waits=False)
        if 0 < self._rate_at_ns <= now_ns:
            self._change_rate(self._rate_at_ns)
        self._watch_angles(now_ns)
        while self._next_ms:
            message, device_ms = min(self._next_ms.items(), key=lambda item: item[1])
            sample_ns = self._instant_ns(device_ms)
            if sample_ns > now_ns:
                return
            self._next_ms[message] = device_ms + self._outputs[message].period_ms
            self._queue_frame(message, sample_ns, device_ms)

    def _watch_angles(self, now_ns: int) -> None:
        while self._alarm_ms is not None and (at_ns := self._instant_ns(self._alarm_ms)) <= now_ns:
            self._alarm_ms += ALARM_PERIOD_MS
            self._pins.alarm(at_ns, is_alarming(self.settings, self._truth(at_ns).euler_rad))

    def _send_marked(self, message: OutputMessage, now_ns: int) -> None:
        if self._enabled and self._outputs[message].on_mark and now_ns >= self._ready_ns:
            spread_ns = self.hardware.mark_spread_ns
            self._queue_frame(
                message, now_ns, self._device_ms(now_ns), round(self._random.uniform(-spread_ns, spread_ns))
            )

    def _queue_frame(self, message: OutputMessage, sample_ns: int, device_ms: int, later_ns: int = 0) -> None:
        """Queue a frame. `later_ns` is an additional delay."""
        processing_ns = max(self.hardware.processing_ns + later_ns, 0)
        ready_ns, size = sample_ns + processing_ns, self._frame_bytes(message)
        if ready_ns < self._quiet_until_ns or not self._wire.fits(ready_ns, size):
            self.frames_dropped += 1
            return
        self.frames_sent += 1
        start_ns = self._wire.due_ns(ready_ns, size) - self._wire.wire_ns(size)
        self._pins.frame(start_ns, min(SOUT_HIGH_NS, processing_ns), self.settings.sout_div, sample_ns)
        self._wire.send(ready_ns, self._encode(message, sample_ns, device_ms), sample_ns, device_ms)

    def _frame_bytes(self, message: OutputMessage) -> int:
        return FRAME_BYTES[message] if message is not OutputMessage.HI83 else 6 + hi83_size(self.hardware.hi83_bitmap)

    def _encode(self, message: OutputMessage, sample_ns: int, device_ms: int) -> bytes:
        reading = self._reading(sample_ns)
        accel, gyro, mag, euler, quat, temperature_c, pressure_pa, *_ = reading
        device_ns = self._device_ns(sample_ns)
        if (self.settings.att_mode == 1 and self.settings.mag_calibration) or self._calibrates:
            self._magnetometer.sample(device_ns, gyro)
        mag = self._magnetometer.measured(mag)
        pps_ms = (device_ns - self._pps_ns) // NS_PER_MS % PPS_MODULUS_MS
        has_status = self.hardware.firmware >= MAIN_STATUS_FIRMWARE
        status = 0
        if has_status:
            uptime_ms, utc = device_ms - self._on_ms, self._utc.synchronised(device_ns)
            status = main_status(reading, uptime_ms, nine_axis=self.settings.att_mode == 1, utc=utc)
        if message in (OutputMessage.HI81, OutputMessage.HI83):
            return encode_ins(message, reading._replace(mag_t=mag), self.hardware.hi83_bitmap, device_ns, status)
        if message is OutputMessage.HI92:
            return encode_hi92(
                pps_stamp_ms=pps_ms, accel_m_s2=accel, gyro_rad_s=gyro, mag_t=mag, euler_rad=euler, quat_wxyz=quat,
                temperature_c=temperature_c, pressure_pa=pressure_pa, status=status,
            )  # fmt: skip
        return encode_hi91(
            system_time_ms=self._utc.shown_ms(device_ns), accel_m_s2=accel, gyro_rad_s=gyro, mag_t=mag, euler_rad=euler,
            quat_wxyz=quat, temperature_c=temperature_c, pressure_pa=pressure_pa,
            word_1_2=status if has_status else pps_ms,
        )  # fmt: skip

    def _reading(self, sample_ns: int) -> Truth:
        """Return the measurement at an instant with noise and mounting."""
        truth = self._truth(sample_ns)
        return self.hardware.noise.add(truth, self._t_s(sample_ns)) if self.hardware.noise else truth

    def _truth(self, at_ns: int) -> Truth:
        """Return the measurement of an ideal device with the same mounting and levelling."""
        truth = self.hardware.motion.at(self._t_s(at_ns))
        truth = self._mounting.turned(truth) if self._mounting.active else truth
        return in_nwu(truth) if self.settings.coord == NWU else truth

    def _t_s(self, at_ns: int) -> float:
        return (at_ns - self.epoch_ns) / NS_PER_S

    def _obey(self, line: str, now_ns: int) -> None:
        if line.startswith("$"):
            self._utc.sentence(line.encode("ascii"), self._device_ns(now_ns))
            return
        behaviour = self.hardware.behaviour
        if line.startswith(behaviour.ignores):
            return
        try:
            if line.startswith(behaviour.refuses):
                raise CommandRefused(line)
            settings = changed(self.settings, line, self.hardware.firmware, behaviour)
            if settings is not None:
                reply: list[str] | None = []
                self._change(settings, now_ns)
            else:
                reply = self._act(line, now_ns)
                if reply is None and behaviour.newer and line not in WITHOUT_OK:
                    raise CommandRefused(line)
        except CommandRefused:
            self._say(["ERR"], now_ns)
            return
        if reply is not None and not self._loses_reply(line):
            self._say([*reply, "OK"], now_ns + behaviour.flash_ms * NS_PER_MS * (line in WRITES_FLASH))
            if line.startswith("SERIALCONFIG") and behaviour.rate_change is RateChange.AFTER_ANSWER:
                self._rate_at_ns = self._wire.due_ns(now_ns, 0) + RATE_CHANGE_NS

    def _loses_reply(self, line: str) -> bool:
        """Return whether the reply to this command is lost: only the first reply."""
        prefixes = [prefix for prefix in self._lost_replies if line.startswith(prefix)]
        self._lost_replies.difference_update(prefixes)
        return bool(prefixes)

    def _change(self, settings: ModuleSettings, now_ns: int) -> None:
        """Apply the settings that a command changed."""
        before, self.settings = self.settings, settings
        if settings.sout_div != before.sout_div:
            self._pins.restart_divider()
        if settings.baud != before.baud and self.hardware.behaviour.rate_change is RateChange.BEFORE_ANSWER:
            self._change_rate(now_ns)
        self._settings_changed(now_ns)

    def _change_rate(self, now_ns: int) -> None:
        """Apply the baud rate. Bytes that wait for the wire are lost."""
        self._rate_at_ns = 0
        self._before_reboot += self._wire.stopped(now_ns)
        self._wire = Transmitter(self.settings.baud, TX_BUFFER_BYTES, now_ns)

    def _say(self, lines: list[str], now_ns: int) -> None:
        if self.hardware.behaviour.newer:
            lines = [*lines[:-1], sentence("GNGGA,,,,,,0,00,,,M,,M,,").decode("ascii").strip(), lines[-1]]
        data = "".join(f"{line}\r\n" for line in lines).encode("ascii")
        self._wire.send(now_ns + REPLY_NS, data)
        self._quiet_until_ns = now_ns + self.hardware.behaviour.quiet_ms * NS_PER_MS

    def _make_actions(self) -> dict[str, Callable[[int], list[str] | None]]:
        """Return the commands that do more than change settings. They return the lines before `OK`, None: no reply."""
        hardware = self.hardware
        version = [
            f"PNAME={hardware.product}",
            f"BUILD={hardware.build}",
            f"UUID={hardware.uuid}",
            f"APP_VER={hardware.firmware}",
            f"BL_VER={hardware.bootloader}",
        ]
        return {
            "REBOOT": self.reboot,
            "AT+RST": lambda now_ns: self._restart(now_ns, waits=True),
            "SAVECONFIG": self._save,
            "FRESET": self._factory_reset,
            "LOG ENABLE": lambda now_ns: self._enable(True, now_ns),
            "LOG DISABLE": lambda now_ns: self._enable(False, now_ns),
            "LOG VERSION": lambda _: version,
            "LOG USRCONFIG": lambda _: self.settings.user_lines(hardware.behaviour),
            "LOG COMCONFIG": lambda _: self.settings.port_lines(hardware.behaviour),
            "LOG MAGCONFIG": lambda _: [
                "MB=" + ", ".join(f"{value / T_PER_UT:.2f}" for value in self._magnetometer.found_t)
            ],
        }

    def _act(self, line: str, now_ns: int) -> list[str] | None:
        action = self._actions.get(line)
        if action is not None:
            return action(now_ns)
        if (reply := self._act_on_other(line)) is not None:
            return reply
        match line.split(" "):
            case ["CONFIG", "ATT", "RST", kind]:
                return self._level(kind, now_ns)
            case ["CONFIG", "YAW", mode, value]:
                return self._set_yaw(mode, value, now_ns)
            case ["LOG", "IMU91" | "HI91" | "HI92" | "HI81" | "HI83" as message, "ONMARK", "ONCE"]:
                self._send_marked(OutputMessage("HI91" if message == "IMU91" else message), now_ns)
                return None if self.hardware.behaviour.newer else []
        return None

    def _act_on_other(self, line: str) -> list[str] | None:
        """Do `_act` for the commands of older and newer firmware. The replies are assumptions."""
        behaviour = self.hardware.behaviour
        match line.split(" "):
            case ["CONFIG", "ATT", "RST", "1" | "4"] if behaviour.older:
                return []  # no document describes the effect
            case ["CONFIG", "MCAL", "START", *plane] if behaviour.newer and plane in ([], ["2D"]):
                self._magnetometer.restart(planar=bool(plane))
                self._calibrates = True
                return []
            case ["LOG", "MCAL", "STAT"] if behaviour.newer:
                state = self._magnetometer.state_text(is_started=self._calibrates)
                return [f"STATE={state}", f"PROGRESS={100 * self._magnetometer.progress:.0f}%"]
            case ["LOG", "INSCONFIG"] if behaviour.ins:
                return [f"BASELINE={self.settings.baseline_m:g}"]
        return None

    def _save(self, _now_ns: int) -> list[str]:
        self.flash = self.settings
        return []

    def _factory_reset(self, now_ns: int) -> list[str]:
        self.flash = ModuleSettings()
        effect = self.hardware.behaviour.factory_reset
        if effect is not ResetEffect.AFTER_RESTART:
            self.settings = self.flash
            if effect is ResetEffect.BEFORE_ANSWER:
                self._change_rate(now_ns)
            self._settings_changed(now_ns)
        return []

    def _enable(self, enabled: bool, now_ns: int) -> list[str]:
        self._enabled = enabled
        self._settings_changed(now_ns)
        return []

    def _attitude(self, now_ns: int) -> Truth:
        """Return the attitude without levelling and without CONFIG YAW."""
        return MountingRotation(self._frame).turned(self.hardware.motion.at(self._t_s(now_ns)))

    def _level(self, kind: str, now_ns: int) -> list[str]:
        """Process CONFIG ATT RST: 2 levels here, 3 only near level (also upside down), 5 cancels."""
        if kind not in ("2", "3", "5"):
            raise CommandRefused(kind)
        attitude = self._attitude(now_ns)
        roll, pitch, _ = attitude.euler_rad
        upside_down = kind == "3" and abs(roll) > pi / 2
        if kind == "3" and max(abs(pitch), pi - abs(roll) if upside_down else abs(roll)) >= NEAR_LEVEL_RAD:
            raise CommandRefused(kind)  # the manual: no effect; assumption: the reply is ERR
        level = ModuleSettings().level if kind == "5" else level_of(attitude.quat_wxyz, upside_down)
        self.settings = replace(self.settings, level=level, level_accel=kind == "3")
        self._settings_changed(now_ns)
        return []

    def _set_yaw(self, mode: str, value: str, now_ns: int) -> list[str]:
        """Process CONFIG YAW: 0 adds to the heading, 1 sets the heading."""
        angle_rad = radians(number(value, -180.0, 180.0))
        if mode not in ("0", "1"):
            raise CommandRefused(mode)
        if mode == "1":
            angle_rad -= self._mounting.turned(self.hardware.motion.at(self._t_s(now_ns))).euler_rad[2]
        self._yaw_rad += angle_rad
        self._settings_changed(now_ns)
        return []


def make(options: SimulatorOptions, now_ns: int) -> HipnucModule:
    """Return a device for the options. Raises ValueError for an unsupported option."""
    period_ms = round(1000 / options.rate_hz) if options.rate_hz > 0 else 0
    if not 1 <= period_ms <= 1000 or abs(period_ms * options.rate_hz - 1000) > 10:
        raise ValueError(f"rate {options.rate_hz:g} Hz: expected 1 … 1000 Hz, and 1000 divided by a whole number")
    if options.message.upper() not in ("", *OutputMessage):
        raise ValueError(f"message {options.message!r}: expected {' or '.join(OutputMessage)}")
    message = OutputMessage(options.message.upper() or OutputMessage.HI91)
    fitting = (b for b, most_hz in MAX_RATE_HZ[message].items() if b >= FACTORY_BAUD and most_hz >= options.rate_hz)
    baud = options.baud or next(fitting)
    if baud not in BAUD_RATES:
        raise ValueError(f"baud {baud}: expected one of {', '.join(map(str, BAUD_RATES))}")
    newer = message in (OutputMessage.HI81, OutputMessage.HI83)
    hardware = HipnucHardware(
        firmware=options.firmware or (INS_FIRMWARE if newer else options.chosen(VARIANTS).firmware),
        **sensor_of(options),
        mark_seed=options.seed,
        behaviour=options.chosen(VARIANTS),
    )
    outputs: dict[str, Any] = {one.lower(): Output(period_ms if one is message else 0) for one in OutputMessage}
    return HipnucModule(now_ns, replace(ModuleSettings(baud=baud), **outputs), hardware)


SIMULATOR = Simulator("hipnuc-uart", "HiPNUC HI14R3 (CH0x0, CH10x, HI14) on a UART", make)
