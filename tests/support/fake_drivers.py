"""Three small drivers for tests.

- `fake-uart`: frames of `5A A5`, u16 length, u16 CRC (XMODEM over all other bytes), payload; and lines of text.
- `fake-can`: a device with node n sends 0x180 + n, eight bytes, one sample per frame.
- `fake-module`: lines of text, and settings of every kind (`FakeModule` is the device).
"""

import asyncio
import binascii
import re
import struct
from collections.abc import Callable, Collection, Generator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from imud.contracts import script
from imud.contracts.codec import BadFrame, BadReason, CodecEvent, StreamCodec
from imud.contracts.command import Calibration, Expectation, Handling, Kept, Proof, Risk, Target, Verb, yaw_at
from imud.contracts.driver import SAMPLE_COUNTER, CanDriver, Identity, StreamDriver
from imud.contracts.setting import DeviceReport, Effect, Reports, Setting, SettingsTable
from imud.formats.can import STANDARD_ID_MAX, CanFilter, CanFrame, CyclicFrame
from imud.links.memory import MemoryLink, MemoryOptions
from imud.model.errors import BadArgument, NoReply, Rejected
from imud.model.ledger import Ledger
from imud.model.options import NoOptions, Options
from imud.model.sample import Measurement
from tests.support.script_runners import of_text

SYNC: Final = b"\x5a\xa5"
PAYLOAD_MAX: Final = 512
QUERY: Final = b"WHO\r\n"
REPLY: Final = b"NAME=FAKE\r\nREV=1\r\nOK\r\n"
BAUD_RATES: Final = (115200, 921600, 460800, 256000, 230400, 9600)

_LINE = re.compile(rb"[\x20-\x7e]{2,60}\r\n")


def fake_frame(payload: bytes) -> bytes:
    head = SYNC + struct.pack("<H", len(payload))
    return head + struct.pack("<H", binascii.crc_hqx(payload, binascii.crc_hqx(head, 0))) + payload


class FakeCodec:
    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self.unknown: dict[int, int] = {}
        self._pending = bytearray()

    def feed(self, data: bytes) -> Sequence[CodecEvent]:
        self.ledger.bytes_in += len(data)
        self._pending += data
        return self._decode(flushing=False)

    def flush(self) -> Sequence[CodecEvent]:
        return self._decode(flushing=True)

    def reset(self) -> None:
        self._pending.clear()

    def _decode(self, *, flushing: bool) -> list[CodecEvent]:
        events: list[CodecEvent] = []
        pending = self._pending
        while (at := pending.find(SYNC)) >= 0:
            self._text(bytes(pending[:at]), events)
            del pending[:at]
            length = int.from_bytes(pending[2:4], "little")
            if len(pending) >= 4 and not 1 <= length <= PAYLOAD_MAX:
                self.ledger.frames_bad_length += 1
                del pending[:2]
                continue
            if len(pending) < 6 or len(pending) < 6 + length:
                if flushing and pending.find(SYNC, 2) > 0:
                    del pending[:2]
                    continue
                return events
            frame = bytes(pending[: 6 + length])
            if fake_frame(frame[6:]) == frame:
                self.ledger.frames_good += 1
                self.ledger.frames_in_samples += 1
                events.append(Measurement(len(frame), len(pending) - len(frame), None))
                del pending[: len(frame)]
            else:
                self.ledger.frames_bad_crc += 1
                events.append(BadFrame(BadReason.CRC, frame))
                del pending[:2]
        consumed = self._text(bytes(pending), events)
        del pending[:consumed]
        del pending[:-64]
        return events

    def _text(self, data: bytes, events: list[CodecEvent]) -> int:
        end = 0
        for line in _LINE.finditer(data):
            self.ledger.frames_good += 1
            self.ledger.frames_in_replies += 1
            events.append(script.TextLine(line[0].decode("ascii").strip()))
            end = line.end()
        return end


def _query(payload: bytes, name: str) -> script.Request:
    is_end, is_error, is_part = (
        of_text(holds) for holds in (lambda line: line == "OK", lambda line: line == "ERR", lambda line: "=" in line)
    )
    return script.Request(payload, name, is_end, is_error, is_part, messages_min=2)


def _identify() -> Generator[script.Request, script.Outcome, Identity]:
    yield _query(QUERY, "WHO")
    return Identity("FAKE")


def _apply(codec: StreamCodec, identity: Identity) -> None: ...


FAKE_DRIVER: Final = StreamDriver(
    name="fake-uart", title="a fake", baud_rates=BAUD_RATES, settings=NoOptions,
    make_codec=lambda ledger, options: FakeCodec(ledger), tick_ns=1_000_000, tick_modulus=1 << 32, euler_convention="",
    navigation_frame="ENU", identify=_identify, apply_identity=_apply,
    example_frame=lambda random: fake_frame(b"\x91" + random.randbytes(75)),
)  # fmt: skip


BASE: Final = 0x180
SYNC_ID: Final = 0x080


class FakeCanSettings(Options, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Node of the device, and whether the device needs SYNC frames."""

    node: Annotated[int, Meta(ge=1, le=127)] = 1
    sync_ms: int = 0


class FakeCanCodec:
    """Each frame of the node is a sample with its first byte as its number. Frames that start with 0xFF are not
    samples."""

    problem = ""

    counts_losses = False

    def __init__(self, ledger: Ledger, settings: FakeCanSettings) -> None:
        self.ledger = ledger
        self.unknown: dict[int, int] = {}
        self._can_id = BASE + settings.node

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        self.ledger.bytes_in += len(data)
        if can_id != self._can_id or extended:
            self.ledger.bytes_skipped += len(data)
            return ()
        self.ledger.bytes_in_good_frames += len(data)
        self.ledger.frames_good += 1
        if data[0] == 0xFF:
            self.ledger.frames_ignored += 1
            return ()
        self.ledger.frames_in_samples += 1
        return (Measurement(len(data), 0, data[0], temperature_c=20.0),)

    def flush(self) -> Sequence[CodecEvent]:
        return ()

    def reset(self) -> None: ...


def _cyclic(settings: FakeCanSettings) -> Sequence[CyclicFrame]:
    return [CyclicFrame(SYNC_ID, False, b"", settings.sync_ms * 1_000_000)] if settings.sync_ms else []


def _renumber(target: Target, *, node: int) -> script.RequestScript[None]:
    settings = msgspec.structs.replace(target.settings, node=node)
    yield script.Request(
        bytes([node]), "renumber", script.never, script.never, script.never, silent=True, settings=settings
    )


def fake_can_driver(name: str = "fake-can", base: int = BASE) -> CanDriver:
    """Return a driver. With another `base`, it detects devices that its codec does not support."""
    return CanDriver(
        name=name, title="a fake", settings=FakeCanSettings, make_codec=FakeCanCodec,
        filters=lambda settings: [CanFilter(BASE + settings.node, STANDARD_ID_MAX, False)], tick_ns=SAMPLE_COUNTER,
        sent_by=lambda settings: [CanFilter(BASE + settings.node, STANDARD_ID_MAX, False)],
        tick_modulus=0xFF, euler_convention="", navigation_frame="",
        node_of=lambda can_id, extended, data: (
            can_id - base if base < can_id <= base + 127 and not extended and len(data) == 8 else None
        ),
        node_settings=lambda node: FakeCanSettings(node=node), node_title=lambda node: f"node {node}",
        identify=lambda _settings: script.says_nothing(Identity("FAKE")), apply_identity=lambda _codec, _identity: None,
        sample_frames=1, example_frames=lambda _random: [CanFrame(BASE + 1, False, bytes(8), 0)], cyclic=_cyclic,
        verbs={
            "node": Verb("its number", lambda target: script.says_nothing(target.settings.node)),
            "renumber": Verb("give it another number", _renumber),
        },
    )  # fmt: skip


def fake_can_frame(node: int, number: int = 0, t_ns: int = 0) -> CanFrame:
    """Return a frame of a device. A frame with number 255 is not a sample."""
    return CanFrame(BASE + node, False, bytes([number, *bytes(7)]), t_ns)


# --- a device with settings of its own --------------------------------------------------------------------------------

FACTORY: Final[Mapping[str, Any]] = {
    "mode": "6-axis", "output": {"a": 100, "b": 0}, "offset_deg": 0.0, "mounting": "level", "secret": 1, "hours": 7,
    "baud": 115200,
}  # fmt: skip
"""Factory settings. `hours` is read-only, `secret` is write-only."""
TOLD: Final = tuple(name for name in FACTORY if name != "secret")


class LinesCodec:
    """Codec of lines that end with CR LF. `S` and ticks of 1 ms is a sample. All other lines are text."""

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self.unknown: dict[int, int] = {}
        self._pending = b""

    def feed(self, data: bytes) -> Sequence[CodecEvent]:
        *lines, self._pending = (self._pending + data).split(b"\r\n")
        ledger = self.ledger
        ledger.bytes_in += len(data)
        ledger.bytes_in_good_frames += sum(len(line) + 2 for line in lines)
        ledger.bytes_pending = len(self._pending)
        ledger.frames_good += len(lines)
        return [self._event(line.decode()) for line in lines]

    def _event(self, line: str) -> CodecEvent:
        if line.startswith("S "):
            self.ledger.frames_in_samples += 1
            return Measurement(len(line) + 2, 0, int(line[2:]), temperature_c=20.0)
        self.ledger.frames_in_replies += 1
        return script.TextLine(line)

    def flush(self) -> Sequence[CodecEvent]:
        return ()

    def reset(self) -> None:
        self.ledger.bytes_skipped += len(self._pending)
        self.ledger.bytes_pending = 0
        self._pending = b""


class FakeModule(MemoryLink):
    """A device at the end of a wire, with active settings, changed settings and settings in flash.

    `mounting` applies after save and restart, all other settings apply immediately.
    """

    def __init__(self, now_ns: Callable[[], int], *, serial: str = "A1", baud: int | Literal["auto"] = 115200) -> None:
        super().__init__(MemoryOptions(name="/dev/fake", baud=baud))
        self.baud = self.baud or 115200
        self.serial = serial
        self.set = dict(FACTORY)
        self.flash = dict(FACTORY)
        self.mounting = "level"
        self.refuses: set[str] = set()  # names of settings that the device answers with ERR
        self.forgets: set[str] = set()  # names of settings that the device confirms and does not store
        self.silent: set[str] = set()
        self.commands: list[str] = []
        self.saves = 0
        self._now_ns = now_ns
        self._boot_ns = now_ns()

    def restart(self) -> None:
        self.set = dict(self.flash)
        self.mounting = self.set["mounting"]
        self._boot_ns = self._now_ns()

    def sample(self) -> None:
        self._send(f"S {(self._now_ns() - self._boot_ns) // 1_000_000}")

    def write(self, data: bytes) -> None:
        super().write(data)
        if self.baud == self.set["baud"]:
            for line in data.decode().splitlines():
                self.commands.append(line)
                asyncio.get_running_loop().call_soon(self._take, line)

    def _take(self, line: str) -> None:
        command, _, rest = line.partition(" ")
        answers: dict[str, Callable[[], list[str]]] = {
            "WHO": self._who, "GET": self._get, "SAVE": self._save, "SET": lambda: self._set(rest),
            "ZERO": lambda: ["OK"],
        }  # fmt: skip
        if command == "RESTART" and command not in self.silent:
            self.restart()
        if command in answers and command not in self.silent:
            for answer in answers[command]():
                self._send(answer)

    def _who(self) -> list[str]:
        return ["NAME=FAKE", f"SN={self.serial}", "OK"]

    def _get(self) -> list[str]:
        values = {**self.set, "mounting": self.mounting}
        return [*(f"{name}={msgspec.json.encode(values[name]).decode()}" for name in TOLD), "OK"]

    def _save(self) -> list[str]:
        self.saves += 1
        if "SAVE" not in self.forgets:
            self.flash = {**self.set, "baud": self.flash["baud"]}
        return ["OK"]

    def _set(self, words: str) -> list[str]:
        name, _, text = words.partition("=")
        value = msgspec.json.decode(text)
        if name in self.refuses:
            return ["ERR"]
        if name == "output":
            value = {**self.set[name], **value}
        elif name == "offset_deg":
            value = round(value, 2)
        if name == "baud" and name not in self.forgets:
            self.flash[name] = value  # active after the restart, also if it was not saved
        elif name != "baud" and name not in self.forgets:
            self.set[name] = value
        return ["OK"]

    def _send(self, line: str) -> None:
        if self.baud == self.set["baud"]:
            self.feed(line.encode() + b"\r\n", self._now_ns())


def _send_command(line: str) -> script.RequestScript[Mapping[str, str]]:
    outcome = yield replace(_query(line.encode() + b"\r\n", line.partition(" ")[0]), messages_min=1)
    if isinstance(outcome, script.Silence):
        raise NoReply(f"{line}: expected OK, got nothing")
    if isinstance(outcome, script.Rejection):
        raise Rejected(f"{line}: the module refused")
    return dict(text.split("=", 1) for text in outcome.lines if "=" in text)


def _who() -> script.RequestScript[Identity]:
    found = yield from _send_command("WHO")
    return Identity(found["NAME"], found["SN"], "1.0")


def _get(_target: Target, _names: Collection[str] | None) -> script.RequestScript[Reports]:
    found = yield from _send_command("GET")
    return {"": DeviceReport(found, {name: msgspec.json.decode(text) for name, text in found.items()})}


def _setter(name: str) -> Callable[[Target, Any], script.RequestScript[None]]:
    def write(_target: Target, value: Any) -> script.RequestScript[None]:
        yield from _send_command(f"SET {name}={msgspec.json.encode(value).decode()}")

    return write


def _save_all(_target: Target) -> script.RequestScript[None]:
    yield from _send_command("SAVE")


def _restart(_target: Target) -> script.RequestScript[None]:
    yield script.Request(b"RESTART\r\n", "RESTART", script.never, script.never, script.never, silent=True)
    yield script.pause(1_000_000_000)


def _write_baud(target: Target, baud: int) -> script.RequestScript[None]:
    yield from _send_command(f"SET baud={baud}")
    yield from _send_command("SAVE")
    yield from _restart(target)
    yield script.pause(1_000_000, baud=baud)
    try:
        yield from _who()
    except NoReply:
        yield script.pause(1_000_000, baud=target.baud)
        raise Rejected(f"the device does not reply at {baud} baud; the bus has {target.baud} baud again") from None


def _parts_agree(declared: Mapping[str, int], actual: Mapping[str, int]) -> bool:
    return declared.items() <= actual.items()


def _carried(target: Target, values: Mapping[str, Any]) -> None:
    rate_hz, baud = sum(values.get("output", {}).values()), values.get("baud", target.baud)
    if baud and rate_hz * 100 > baud:
        raise BadArgument(f"output: expected at most {baud // 100} Hz in all at {baud} baud, got {rate_hz} Hz")


def _told(words: str, section: str, unit: str = "") -> Meta:
    return Meta(description=words, extra={"section": section, "unit": unit})


OutputRates = dict[Literal["a", "b"], Annotated[int, Meta(ge=0, le=1000)]]
FAKE_SETTINGS: Final = SettingsTable(
    table={
        "baud": Setting(
            type=Annotated[Literal[9600, 115200, 921600], _told("rate of the line", "3.1", "bit/s")],
            write=_write_baud, connection=True, saves=True,
        ),
        "mode": Setting(
            type=Annotated[Literal["6-axis", "9-axis"], _told("axes that make the attitude", "2.1")],
            write=_setter("mode"),
        ),
        "output": Setting(
            type=Annotated[OutputRates, _told("messages sent per second", "2.2", "Hz")], write=_setter("output"),
            agrees=_parts_agree,
        ),
        "mounting": Setting(
            type=Annotated[Literal["level", "x_up"], _told("what points up", "2.4")], write=_setter("mounting"),
            effect=Effect.AFTER_RESTART,
        ),
        "offset_deg": Setting(
            type=Annotated[float, Meta(ge=-180, le=180), _told("added to the heading", "2.3", "°")],
            write=_setter("offset_deg"), agrees=lambda declared, actual: abs(declared - actual) < 0.01,
        ),
        "secret": Setting(
            type=Annotated[int, Meta(ge=0, le=9), _told("a number that is not told", "2.5")], write=_setter("secret"),
            readable=False,
        ),
        "hours": Setting(type=Annotated[int, _told("time in use", "2.6", "h")]),
    },
    read=_get, save=_save_all, restart=_restart, check=_carried,
)  # fmt: skip


ZERO: Final = Calibration(
    help="measure the zero", section="4.1", handling=Handling.REST, instructions=(),
    begin=lambda _target: _send_command("ZERO"), expected=(), kept=Kept.BY_SAVE, save=_save_all,
)  # fmt: skip


def _who_again(_target: Target) -> script.RequestScript[None]:
    yield from _who()


def _turned(_target: Target, *, angle_deg: float) -> script.RequestScript[None]:
    yield from _who()


def _heading_expected(given: Any) -> Sequence[Expectation]:
    return () if given.angle_deg > 180 else (yaw_at(given.angle_deg),)


def _set_mode(target: Target, *, mode: str) -> script.RequestScript[None]:
    return _setter("mode")(target, mode)


FAKE_MODULE_DRIVER: Final = replace(
    FAKE_DRIVER, name="fake-module", make_codec=lambda ledger, options: LinesCodec(ledger), identify=_who,
    device_settings=FAKE_SETTINGS, calibrations={"zero": ZERO},
    verbs={
        "set_mode": Verb("set it", _set_mode),
        "wait": Verb("take an hour", lambda _target: (script.pause(3600 * 1_000_000_000) for _ in range(1))),
        "save": Verb("save all", _save_all, saves=True, changes=False),
        "restart": Verb("restart it", _restart, restarts=True, proof=Proof.RESTART),
        "factory_reset": Verb("forget all", _restart, Risk.RESET, restarts=True, proof=Proof.SETTINGS),
        "once": Verb("send a sample", _who_again, changes=False, proof=Proof.ONE_SAMPLE),
        "wake": Verb("send samples", _who_again, proof=Proof.STREAM),
        "turn": Verb("set the heading", _turned, changes=False, proof=Proof.SAMPLES, expected=_heading_expected),
    },
)  # fmt: skip
