"""Replies of HiPNUC devices to ASCII commands: kinds of messages, and the lines of the reports of LOG.

Manual "IMU配置手冊" V1.5.9, sections 2.2.5 and 8.1.1, which show one line of USRCONFIG and one line of MAGCONFIG; LOG
VERSION as sent by firmware 1.5.6:

    PNAME=HI14R3 | BUILD=Oct 15 2024 | UUID=043995698D6E1708 | APP_VER=156 | BL_VER=109 | OK
    ATT_MODE: 0  | …                                                                    | OK
    …            | MB=14.14, -2.08, -8.75                                               | OK

The manual does not document other lines, so imud keeps every line: NAME=VALUE and NAME: VALUE by name, others
unchanged.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import ClassVar, Final, NamedTuple

from imud.contracts.codec import BadFrame, BadReason, count_unknown
from imud.contracts.script import Message, TextLine
from imud.drivers.state import DAEMON, FLAG
from imud.formats.nmea0183 import checksum
from imud.formats.state import Data, Field, Integer, StateTable
from imud.model.ledger import Ledger

_VERSION_LINE: Final = re.compile(r"\s*(?:PNAME|BUILD|UUID|APP_VER|BL_VER)\s*[=:].*")
_VALUE_LINE: Final = re.compile(r"\s*([A-Za-z][A-Za-z0-9_.\-]*)\s*[=:]\s*(.*?)\s*")
_COMMENT: Final = re.compile(r"\s*/\*.*?(\*/|$)")
# `LOG HI91 ONTIME 0.01`, `LOG COM2 HI91 ONTIME 0.01` or `HI91 COM2 ONTIME 0.01`; INS models also have other messages
_MESSAGE: Final = r"(?:\bCOM(\d+)\s+)?\b(?:(?:IMU|HI)(81|83|91|92)|(GGA|RMC|SXT))\s+(?:COM(\d+)\s+)?"
_OUTPUT: Final = re.compile(_MESSAGE + r"(?:ONTIME\s+(\d+(?:\.\d*)?|\.\d+)|ONMARK\s+(1)\b)")


def is_end(message: Message) -> bool:
    """Return whether a message ends a positive reply: the line OK in any case."""
    return isinstance(message, str) and message.strip().upper() == "OK"


def is_rejection(message: Message) -> bool:
    """Return whether a message is a rejection: ERR with any text, but not a setting whose name starts with ERR."""
    return isinstance(message, str) and message.lstrip().upper().startswith("ERR") and "=" not in message


def is_version_line(message: Message) -> bool:
    """Return whether a message can be part of the reply to LOG VERSION."""
    return isinstance(message, str) and _VERSION_LINE.fullmatch(message) is not None


def is_setting_line(message: Message) -> bool:
    """Return whether a message can be part of another report (not documented).

    A version line and an NMEA sentence of newer firmware, which can arrive between the lines, are not part of it.
    """
    return isinstance(message, str) and not _VERSION_LINE.fullmatch(message) and not message.startswith("$")


@dataclass(frozen=True, slots=True)
class Report:
    """Lines of a reply, by name if they have a known form."""

    values: Mapping[str, str]  # values by the names of the device
    other: tuple[str, ...]  # lines of another form, unchanged


@dataclass(frozen=True, slots=True)
class Version:
    """Reply to LOG VERSION. Fields are empty or None if the device does not send them."""

    product: str
    build: str
    uuid: str
    app_ver: int | None  # 156 for firmware 1.5.6
    bl_ver: int | None  # version of the boot loader
    report: Report


class PeriodicOutputs(NamedTuple):
    """Outputs in a reply to LOG COMCONFIG. Its form is not documented: imud looks for the form of the command."""

    periods_s: Mapping[str, float]  # output periods by message (`OutputMessage`); 0 is off
    on_mark: frozenset[str]  # messages for each pulse on SIN
    ports: "Mapping[str, PeriodicOutputs]"  # outputs of other ports, by name (`COM2`)


def parse_report(lines: Sequence[str]) -> Report:
    """Return the lines of a reply by name, without the end line and comments (`/* … */`)."""
    values: dict[str, str] = {}
    other: list[str] = []
    for line in lines:
        match = _VALUE_LINE.fullmatch(_COMMENT.sub("", line))
        if is_end(line):
            continue
        if match and match[1] not in values:
            values[match[1]] = match[2]
        else:
            other.append(line)
    return Report(values, tuple(other))


def parse_version(lines: Sequence[str]) -> Version:
    """Return the values of a reply to LOG VERSION."""
    report = parse_report(lines)
    get = report.values.get
    return Version(
        get("PNAME", ""), get("BUILD", ""), get("UUID", ""), whole(get("APP_VER")), whole(get("BL_VER")), report
    )


def parse_comconfig(lines: Iterable[str]) -> PeriodicOutputs:
    """Return the outputs in a reply to LOG COMCONFIG.

    Lines without a port are about the port of imud. If the reply names only one port, this is the port of imud.
    """
    periods_s: dict[str, dict[str, float]] = {}
    on_mark: dict[str, set[str]] = {}
    for line in lines:
        for before, number, sentence, after, period, _ in _OUTPUT.findall(line):
            port, message = before or after, sentence or f"HI{number}"
            periods, marks = periods_s.setdefault(port, {}), on_mark.setdefault(port, set())
            if period:
                periods[message] = float(period)
            else:
                marks.add(message)
    named = sorted(periods_s.keys() - {""})
    if len(named) == 1 and "" not in periods_s:
        periods_s[""], on_mark[""] = periods_s.pop(named[0]), on_mark.pop(named.pop())
    ports = {f"COM{port}": PeriodicOutputs(periods_s[port], frozenset(on_mark[port]), {}) for port in named}
    return PeriodicOutputs(periods_s.get("", {}), frozenset(on_mark.get("", ())), ports)


def whole(text: str | None) -> int | None:
    """Return the number in a value; None for another text."""
    return int(text) if text is not None and text.isdecimal() else None


def numbers_of(text: str, count: int) -> list[float] | None:
    """Return the numbers of a vector or matrix; None for another text."""
    try:
        numbers = list(map(float, text.split(",")))
    except ValueError:
        return None
    return numbers if len(numbers) == count and all(map(isfinite, numbers)) else None


# Maximum length of a line without its end. Replies in the manual are below 80; more means a lost line end.
LINE_CHARACTERS_MAX: Final = 255

_PRINTABLE: Final = bytes([0x09, *range(0x20, 0x7F)])

# NMEA 0183 sentence of newer firmware, for example `$GNGGA,…*5C`, with the last three letters of its address
_SENTENCE: Final = re.compile(rb"\$([A-Z][A-Z0-9]{0,4}([A-Z0-9]{3})(?:,[^*$]*)?)\*([0-9A-Fa-f]{2})")
SENTENCE_TYPE_MIN: Final = 1 << 16  # minimum number of a sentence type; tags of sub-packets are smaller


def sentence_name(sentence_type: int) -> str:
    """Return the name of a sentence type, for example `NMEA sentence GGA`."""
    return f"NMEA sentence {sentence_type.to_bytes(3, 'big').decode('ascii')}"


class LineFinder:
    """Finder of text lines across reads and frames. It counts every byte in the ledger: good, bad, skipped, or pending.

    Text inside a damaged frame is not a line, because its first characters may be the last bytes of the frame. An NMEA
    sentence is not part of a reply: it counts as an ignored frame in `unknown`, and as a damaged frame if its checksum
    is wrong.
    Synchronization: one thread. Holds at most LINE_CHARACTERS_MAX + 1 bytes.
    """

    STATE: ClassVar = StateTable(
        (
            Field(1, "_held", Data(LINE_CHARACTERS_MAX + 1)),
            Field(2, "_held_bad", Integer(0, LINE_CHARACTERS_MAX + 1)),
            Field(3, "_held_barred", Integer(0, LINE_CHARACTERS_MAX + 1)),
            Field(4, "_overlong", FLAG),
        ),
        {"_ledger": DAEMON, "_unknown": "the counts of the codec"},
    )

    def __init__(self, ledger: Ledger, unknown: dict[int, int]) -> None:
        self._ledger = ledger
        self._unknown = unknown  # number of sentences by type
        self._held = b""  # printable characters without a line end, with a possible CR
        self._held_bad = 0  # number of the first held bytes inside a damaged frame by its length field
        self._held_barred = 0  # number of these bytes inside a complete damaged frame
        self._overlong = False  # whether the line is too long: the finder drops it up to its end

    @property
    def pending_bytes(self) -> int:
        """Number of bytes of the incomplete line."""
        return len(self._held)

    def add(self, data: bytes, bad: int, barred: int) -> list[TextLine | BadFrame]:
        """Add bytes outside frames. Return complete lines, and NMEA sentences with a wrong checksum.

        The first `bad` bytes are inside a damaged frame, the first `barred` bytes inside a complete damaged frame. Both
        can be negative or more than all bytes.
        """
        lines: list[TextLine | BadFrame] = []
        ledger, start = self._ledger, 0
        while start < len(data):
            feed = data.find(b"\n", start)
            self._extend(data[start : feed if feed >= 0 else None], max(bad - start, 0), max(barred - start, 0))
            if feed < 0:
                break
            start = feed + 1
            text = self._held.removesuffix(b"\r")
            if text and not (barred > feed or self._held_barred):
                if (line := self._completed(text, self._held + b"\n")) is not None:
                    lines.append(line)
                self._held, self._held_bad = b"", 0
                continue
            self.break_off()
            if bad > feed:
                ledger.bytes_in_bad_frames += 1
            else:
                ledger.bytes_skipped += 1
        return lines

    def _completed(self, text: bytes, data: bytes) -> TextLine | BadFrame | None:
        """Count a complete line of the bytes `data`, with its line end. Return None for an NMEA sentence."""
        ledger, sentence = self._ledger, _SENTENCE.fullmatch(text)
        if sentence and checksum(sentence[1]) != int(sentence[3], 16):
            ledger.bytes_in_bad_frames += len(data)
            ledger.frames_bad_crc += 1
            return BadFrame(BadReason.CRC, data)
        ledger.bytes_in_good_frames += len(data)
        ledger.frames_good += 1
        if sentence:
            ledger.frames_ignored += 1
            count_unknown(self._unknown, int.from_bytes(sentence[2], "big"))
            return None
        ledger.frames_in_replies += 1
        return TextLine(text.decode("ascii"))

    def break_off(self) -> None:
        """Drop the incomplete line, because bytes other than text follow."""
        self._drop(len(self._held))
        self._overlong = False

    def clear(self) -> None:
        """Skip the held bytes after an interruption of the stream."""
        self._held_bad = self._held_barred = 0
        self.break_off()

    def _extend(self, part: bytes, bad: int, barred: int) -> None:
        """Append `part` without LF. Keep the printable characters after the last other byte."""
        self._held_bad += min(bad, len(part))
        self._held_barred += min(barred, len(part))
        held = self._held = self._held + part
        returned = held.endswith(b"\r")
        body = held[:-1] if returned else held
        characters = len(body) - len(body.rstrip(_PRINTABLE))
        if characters < len(body):
            self._overlong = False
            self._drop(len(body) - characters)
        if characters > LINE_CHARACTERS_MAX:
            self._overlong = True
        if self._overlong:
            self._drop(characters)

    def _drop(self, count: int) -> None:
        """Drop the first `count` held bytes."""
        bad = min(count, self._held_bad)
        self._ledger.bytes_in_bad_frames += bad
        self._ledger.bytes_skipped += count - bad
        self._held_bad -= bad
        self._held_barred -= min(count, self._held_barred)
        self._held = self._held[count:]
