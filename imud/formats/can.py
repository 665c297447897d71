"""CAN frames (ISO 11898-1), filters, `struct can_frame` and `struct canfd_frame` of the kernel, and candump logs.

A link delivers frames to a codec as `CanFrame`. It sends frames as `struct can_frame`, so that a command consists of
bytes on every kind of link. Only simulated devices send CAN FD frames.
"""

import re
import struct
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import BinaryIO, Final, NamedTuple

from imud.model.errors import BadArgument
from imud.model.units import NS_PER_MS, NS_PER_S

DATA_BYTES_MAX: Final = 8  # maximum number of data bytes of a classical CAN frame (ISO 11898-1)
# Possible numbers of data bytes of a CAN FD frame (ISO 11898-1)
FD_LENGTHS: Final = (*range(DATA_BYTES_MAX + 1), 12, 16, 20, 24, 32, 48, 64)
FD_DATA_BYTES_MAX: Final = FD_LENGTHS[-1]
STANDARD_ID_MAX: Final = 0x7FF
EXTENDED_ID_MAX: Final = 0x1FFF_FFFF
# Flag in the identifier of `struct can_frame`: 29 bits (CAN_EFF_FLAG of linux/can.h)
EXTENDED_FLAG: Final = 0x8000_0000
REMOTE_FLAG: Final = 0x4000_0000  # flag in the identifier: a remote frame, without data (CAN_RTR_FLAG)
# Flag in the identifier: an error frame of the controller, not a frame of the bus (CAN_ERR_FLAG)
ERROR_FLAG: Final = 0x2000_0000

# `struct can_frame` in the byte order of the host: identifier with flags, length, data
RAW_FRAME: Final = struct.Struct("=IB3x8s")
# `struct canfd_frame`: the same with flags after the length. Length and data have the places of `struct can_frame`.
RAW_FD_FRAME: Final = struct.Struct("=IBB2x64s")
FD_FLAGS: Final = 0x05  # flags of sent CAN FD frames: fast data phase (CANFD_BRS), and CAN FD (CANFD_FDF)
STANDARD_OVERHEAD_BITS, EXTENDED_OVERHEAD_BITS = 47, 67
"""Length of a frame without data and stuff bits, with three bits of interframe space (ISO 11898-1), for 11 and 29
bits.
"""


INTERFACE_BYTES_MAX: Final = 15  # maximum length of the name of a network interface (IFNAMSIZ - 1)


def interface_problem(name: str) -> str:
    """Return why the kernel refuses this name of an interface; empty if it accepts the name."""
    is_valid = len(name.encode()) <= INTERFACE_BYTES_MAX and name not in (".", "..")
    if is_valid and not any(character in "/:" or character.isspace() for character in name):
        return ""
    return (
        f"expected the name of a network interface, at most {INTERFACE_BYTES_MAX} bytes without slash, colon and "
        f"spaces, got {name}; the command ip link lists the interfaces"
    )


class CanFrame(NamedTuple):
    """Received data frame."""

    can_id: int  # identifier without flags
    extended: bool  # whether the identifier has 29 bits
    data: bytes
    t_rx_ns: int  # arrival time, CLOCK_MONOTONIC, ns: the time stamp of the kernel if it exists
    after_loss: bool = False  # whether frames were lost immediately before this frame


@dataclass(frozen=True, slots=True)
class CanFilter:
    """Filter for identifiers that are equal to `can_id` in the bits of `mask`."""

    can_id: int
    mask: int
    extended: bool

    def matches(self, can_id: int, extended: bool) -> bool:
        """Return whether a frame passes the filter."""
        return extended == self.extended and not (can_id ^ self.can_id) & self.mask

    def overlaps(self, other: "CanFilter") -> bool:
        """Return whether a frame exists that passes both filters."""
        return self.extended == other.extended and not (self.can_id ^ other.can_id) & self.mask & other.mask


@dataclass(frozen=True, slots=True)
class CyclicFrame:
    """Frame that imud sends periodically because devices need it, for example CANopen SYNC. One device of a bus
    requests the frame for all devices. imud rejects a second device with the same identifier."""

    can_id: int
    extended: bool
    data: bytes
    every_ns: int  # period in whole microseconds. imud sends the first frame immediately.


def frame_bits(extended: bool, data_bytes: int) -> int:
    """Return the bits of a frame on the wire with interframe space. Stuff bits add up to 22 %."""
    return (EXTENDED_OVERHEAD_BITS if extended else STANDARD_OVERHEAD_BITS) + 8 * data_bytes


def pack_frame(can_id: int, extended: bool, data: bytes) -> bytes:
    """Return a frame as `struct can_frame`; with more than eight data bytes, as `struct canfd_frame`.

    Raises ValueError for an identifier or a length out of range.
    """
    size = len(data)
    if not 0 <= can_id <= (EXTENDED_ID_MAX if extended else STANDARD_ID_MAX) or size not in FD_LENGTHS:
        raise ValueError(f"invalid CAN frame: identifier {can_id:#x}{' (29 bits)' * extended}, {size} data bytes")
    flagged_id = can_id | EXTENDED_FLAG if extended else can_id
    is_fd = size > DATA_BYTES_MAX
    return RAW_FD_FRAME.pack(flagged_id, size, FD_FLAGS, data) if is_fd else RAW_FRAME.pack(flagged_id, size, data)


def pack_filters(filters: Sequence[CanFilter]) -> bytes:
    """Return filters as `struct can_filter`: data frames only, with the given length of the identifier."""
    flags = EXTENDED_FLAG | REMOTE_FLAG
    return b"".join(struct.pack("=II", f.can_id | EXTENDED_FLAG * f.extended, f.mask | flags) for f in filters)


# Maximum length of a line, bytes. CAN FD with 64 data bytes and a long bus name needs about 190.
LINE_BYTES_MAX: Final = 512
_FRAME: Final = re.compile(
    rb"\((\d{1,18})\.(\d{1,9})\) +(\S+) +([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    rb"#(?:((?:[0-9A-Fa-f]{2}){0,8})(?:_[0-9A-Fa-f])?|#[0-9A-Fa-f]((?:[0-9A-Fa-f]{2}){0,64}))(?: [RT])?\s*"
)
_OTHER: Final = re.compile(rb"\(\d{1,18}\.\d{1,9}\) +\S+ +[0-9A-Fa-f]{3,8}#R[\dA-Fa-f_]*(?: [RT])?\s*")


# Maximum fall of the time from line to line that is not a step of the clock, ns: lines of candump can change places
DISORDER_NS: Final = NS_PER_MS
# Minimum rise of the time from line to line that counts as a step of the clock, ns. A shorter rise is a pause.
STEP_NS: Final = 3600 * NS_PER_S
PAUSE_NS: Final = 10 * NS_PER_S  # minimum pause that imud reports, ns
# Minimum shift of the times of an identifier that imud reports, ns. A step of 1 ms changes a distance by about 1 ms.
SHIFT_NS: Final = NS_PER_MS * 9 // 10
MILLISECONDS_NS: Final = NS_PER_MS  # the same in a log with times in whole milliseconds
SHIFT_PERIOD_NS: Final = NS_PER_S  # maximum distance of the times of such an identifier, ns
SHIFT_IDS: Final = 256  # maximum number of identifiers whose shifts imud detects
REGULAR, SHIFTED = 8, 4  # number of regular distances before and after a shift
PAUSES_KEPT: Final = 16  # number of known distances. The longest one replaces the unknown distance at a step.
PAUSE: Final = "a pause or a step of the clock"
SHIFT_BACKWARD: Final = "a step of the clock, or another phase of the sender"
SHIFT_FORWARD: Final = "lost frames, a pause or a step of the clock"
JUMPS_SHOWN: Final = 5  # maximum number of steps and pauses in a text
IDENTIFIERS_MAX: Final = 4096  # maximum number of known identifiers
FIRST: Final = 2  # number of known frames of each identifier
DIFFERENCES_NS: Final = NS_PER_S  # maximum first time of a log of time differences, ns
DIFFERENCES_LINES, DIFFERENCES_FALLS = 64, 3  # number of first lines and of their falls that show time differences
EXCURSION_FRAMES: Final = 32  # maximum number of consecutive frames with wrong times
EXCURSION_DISTANCES: Final = 8  # minimum number of correct distances before an excursion
EXCURSION_NS: Final = 10 * NS_PER_MS  # minimum deviation of a wrong time from the usual distances, ns
EQUAL_MIN: Final = 16  # minimum number of frames of a log whose times imud checks
# Number of successive frames with one time that a bus cannot send in the resolution of the clock, nor an adapter hold
STILL_FRAMES: Final = 256
INTERFACES_MAX: Final = 16  # maximum number of interfaces in a text


def _text(name: bytes) -> str:
    return name.decode("ascii", "backslashreplace")


def _listed(names: Iterable[str], word: str) -> str:
    *rest, last = [name if name.isprintable() else ascii(name) for name in list(names)[:INTERFACES_MAX]]
    return f"{', '.join(rest)} {word} {last}" if rest else last


def _several(names: Iterable[str]) -> BadArgument:
    return BadArgument(
        f"the log has frames of the interfaces {_listed(names, 'and')}: select one of them (--interface, key interface)"
    )


class _Times:
    """Times of one identifier. A shift of regular times can be a step of the clock that is shorter than the distances
    of the lines.
    """

    __slots__ = ("_distances_ns", "_newest_ns", "_since", "_step")

    def __init__(self, t_ns: int) -> None:
        self._newest_ns = t_ns
        self._distances_ns: deque[int] = deque(maxlen=REGULAR)
        self._step = (0, 0)  # line and size of a possible shift, ns; 0: none
        self._since = 0  # number of regular distances since then

    def add(self, t_ns: int, number: int) -> tuple[int, int] | None:
        """Add the time of a line. Return line and size (ns) of an earlier shift if this line proves it."""
        distance_ns, self._newest_ns = t_ns - self._newest_ns, t_ns
        known = sorted(self._distances_ns)
        if len(known) == REGULAR:
            usual_ns, spread_ns = known[REGULAR // 2], known[-1] - known[0]
            rise_ns = distance_ns - usual_ns
            if abs(rise_ns) <= max(spread_ns, SHIFT_NS // 2):
                self._since += 1
                if self._step[0] and self._since == SHIFTED:
                    step, self._step = self._step, (0, 0)
                    return step
            elif (
                abs(rise_ns) > max(2 * spread_ns, SHIFT_NS if t_ns % NS_PER_MS else MILLISECONDS_NS)
                and usual_ns <= SHIFT_PERIOD_NS
                and not self._step[0]
            ):
                self._step, self._since = (number, rise_ns), 0
                return None
            else:
                self._step = (0, 0)
                self._distances_ns.clear()
        self._distances_ns.append(distance_ns)
        return None


class _TimeKind:
    """Check that the times of a log are times of a clock."""

    def __init__(self) -> None:
        self._first_ns = self._newest_ns = self._frames = self._falls = self._equal = 0
        self._longest = (0, 0)  # longest run of equal times: number of frames, number of its last line

    @property
    def problem(self) -> str:
        """The part of the log with a stopped clock; empty if there is none."""
        frames, number = self._longest
        return f"line {number}: the last {frames} frames have the same time (the clock stopped)" if frames else ""

    def add(self, t_ns: int, number: int) -> None:
        """Add the time of a frame. Raises BadArgument for time differences."""
        distance_ns, self._newest_ns = t_ns - self._newest_ns, t_ns
        self._frames += 1
        if self._frames == 1:
            self._first_ns = t_ns
            return
        self._equal = 0 if distance_ns else self._equal + 1
        if self._equal + 1 >= max(STILL_FRAMES, self._longest[0]):
            self._longest = (self._equal + 1, number)
        self._falls += distance_ns < 0
        is_often = self._falls >= max(DIFFERENCES_FALLS, self._frames // 12)
        if self._first_ns < DIFFERENCES_NS and is_often and self._frames <= DIFFERENCES_LINES:
            raise BadArgument(
                f"line {number}: expected times of a clock, got time differences (candump -t d): record the log again "
                "with candump -L"
            )

    def end(self) -> None:
        """Raise BadArgument if half of the frames have the time of the last frame."""
        if self._frames >= EQUAL_MIN and self._equal > self._frames // 2:
            raise BadArgument(
                f"expected rising times, got {self._equal + 1} successive frames with the time "
                f"{self._newest_ns / NS_PER_S:.6f} s: record the log again with candump -L"
            )


class LogLine(NamedTuple):
    """Data frame of a log with its time, before imud removes steps of the clock."""

    log_ns: int
    number: int  # number of the line
    frame: CanFrame  # without its time


class _Excursions:
    """Removal of wrong times that last for some frames: the clocks of two cores disagree, or a hardware time stamp is
    wrong. The times then return to the times before. A pause and a step of the clock have no return.
    """

    def __init__(self) -> None:
        self._newest_ns: int | None = None  # newest correct time
        self._distances_ns: deque[int] = deque(maxlen=PAUSES_KEPT)
        self._held: list[LogLine] = []  # lines with times that can be wrong
        self._count = 0  # number of removed excursions
        self._first = ""  # description of the first excursion

    @property
    def problem(self) -> str:
        """The removed excursions; empty without one."""
        more = f" and {self._count - 1} times later" if self._count > 1 else ""
        return f"{self._first}{more} (clocks that disagree, corrected by imud)" if self._count else ""

    def removed_from(self, lines: Iterable[LogLine]) -> Iterator[LogLine]:
        """Yield the lines. Correct the times of an excursion."""
        for line in lines:
            if not self._held:
                if self._may_start(line.log_ns):
                    self._held.append(line)
                else:
                    self._accept(line.log_ns)
                    yield line
                continue

            if self._is_return(line.log_ns):
                yield from self._corrected(line.log_ns)
                self._accept(line.log_ns)
                yield line
                continue

            self._held.append(line)
            if len(self._held) > EXCURSION_FRAMES:
                yield from self._release()
        yield from self._release()

    def _accept(self, log_ns: int) -> None:
        if self._newest_ns is not None:
            self._distances_ns.append(max(log_ns - self._newest_ns, 0))
        self._newest_ns = log_ns

    def _may_start(self, log_ns: int) -> bool:
        if self._newest_ns is None or len(self._distances_ns) < EXCURSION_DISTANCES:
            return False
        rise_ns = log_ns - self._newest_ns
        return rise_ns < -DISORDER_NS or self._is_unusual_rise(rise_ns)

    def _is_unusual_rise(self, rise_ns: int) -> bool:
        return rise_ns > max(self._distances_ns) + EXCURSION_NS

    def _is_return(self, log_ns: int) -> bool:
        """Return whether a time continues the times before the held lines, and has a step back to them.

        After a short step of the clock to the past, the times reach the times before in their usual distances.
        """
        if self._newest_ns is None:
            return False
        limit_ns = 2 * (len(self._held) + 1) * max(self._distances_ns) + EXCURSION_NS
        is_near = -DISORDER_NS <= log_ns - self._newest_ns <= limit_ns
        is_ahead = self._held[0].log_ns > self._newest_ns
        step_ns = log_ns - self._held[-1].log_ns
        has_step_back = step_ns < -DISORDER_NS if is_ahead else self._is_unusual_rise(step_ns)
        return is_near and has_step_back

    def _corrected(self, return_ns: int) -> Iterator[LogLine]:
        """Yield the held lines in the middle between the times before and after them."""
        lines, self._held = self._held, []
        start_ns = self._newest_ns or 0
        room_ns = max(return_ns - start_ns, 0)
        times_ns = [line.log_ns - lines[0].log_ns for line in lines]
        if min(times_ns) < 0 or max(times_ns) > room_ns:
            times_ns = [0] * len(lines)
        first_ns = start_ns + (room_ns - max(times_ns)) // 2
        shift_ns = lines[0].log_ns - first_ns
        self._count += 1
        if self._count == 1:
            self._first = (
                f"line {lines[0].number}: the times of {len(lines)} frames differ by {shift_ns / NS_PER_S:+.3f} s"
            )
        for line, time_ns in zip(lines, times_ns, strict=True):
            self._accept(first_ns + time_ns)
            yield line._replace(log_ns=first_ns + time_ns)

    def _release(self) -> Iterator[LogLine]:
        """Yield the held lines with their own times: a pause, or a step of the clock."""
        lines, self._held = self._held, []
        for line in lines:
            self._accept(line.log_ns)
            yield line


class CandumpReader:
    """Reader of one interface of a candump log from a binary stream. Iterate once.

    `t_rx_ns` is the time in the log and does not fall. After a step of the clock, it continues with a new offset, and
    the frame has `after_loss`.
    """

    def __init__(self, file: BinaryIO, interface: str = "") -> None:
        """`interface`: interface of the frames; empty if the log has one interface."""
        self._file = file
        self.interface = interface
        self.passed_over = 0  # number of valid lines without a data frame
        self.bad_lines = 0
        self.first_bad = 0  # number of the first invalid line, starting at 1; 0 if all lines are valid
        self.identifiers: dict[tuple[int, bool], list[CanFrame]] = {}  # first frames of each identifier, at most FIRST
        self._is_chosen = bool(interface)
        self._has_frames = False
        self._others: dict[str, None] = {}  # names of the ignored interfaces
        self._jumps: list[str] = []  # descriptions of the first steps and pauses
        self._jump_count = 0
        self._newest_ns: int | None = None  # newest time in the log
        self._offset_ns = 0  # offset of the newest time to `t_rx_ns`
        self._distances_ns: deque[int] = deque(maxlen=PAUSES_KEPT)
        self._times: dict[int, _Times] = {}  # times since the newest step by identifier
        self._kind = _TimeKind()
        self._excursions = _Excursions()

    @property
    def problem(self) -> str:
        """Problems of the file after the iteration, one sentence; empty if there is no problem."""
        found = list(self._jumps)
        if self._excursions.problem:
            found.append(self._excursions.problem)
        if self._jump_count > len(self._jumps):
            found.append(f"{self._jump_count - len(self._jumps)} more steps or pauses")
        if self._kind.problem:
            found.append(self._kind.problem)
        if self.bad_lines:
            found.append(
                f"expected a candump log (candump -L), got {self.bad_lines} invalid lines "
                f"(first: line {self.first_bad})"
            )
        elif not self.identifiers:
            found.append(f"found no data frame, and {self.passed_over} error frames or remote frames")
        return "; ".join(found)

    def __iter__(self) -> Iterator[CanFrame]:
        """Yield the frames of the interface. Raises BadArgument for several interfaces, or for an unknown interface."""
        for line in self._excursions.removed_from(self._lines()):
            can_id, extended, data, _, _ = line.frame
            t_ns, is_jump = self._time(line.log_ns, line.number)
            self._look_for_shift(can_id, t_ns, line.number)
            frame = CanFrame(can_id, extended, data, t_ns, is_jump)
            if len(self.identifiers) < IDENTIFIERS_MAX:
                first = self.identifiers.setdefault((can_id, extended), [])
                if len(first) < FIRST:
                    first.append(frame)
            yield frame

    def _lines(self) -> Iterator[LogLine]:
        """Yield the lines with data frames of the interface."""
        number = 0
        if not self.interface and self._file.seekable():
            self._choose_interface()
        while line := self._file.readline(LINE_BYTES_MAX):
            number += 1
            match = _FRAME.fullmatch(line)
            if match is None:
                self._note(line, number)
                continue
            seconds, fraction, name, digits, classical, fast = match.groups()
            can_id, data = int(digits, 16), bytes.fromhex((fast or classical or b"").decode("ascii"))
            if len(data) not in FD_LENGTHS:
                self._note(line, number)
                continue
            if can_id > EXTENDED_ID_MAX or (len(digits) == 3 and can_id > STANDARD_ID_MAX):
                self._note(b"bad", number, passed=bool(can_id & ERROR_FLAG))
                continue
            if self._is_own(_text(name)):
                log_ns = int(seconds) * NS_PER_S + int(fraction.ljust(9, b"0"))
                yield LogLine(log_ns, number, CanFrame(can_id, len(digits) == 8, data, 0))
        self._kind.end()
        if self._others and not self._has_frames:
            raise BadArgument(f"interface {self.interface}: expected {_listed(self._others, 'or')}, as in the log")

    def _choose_interface(self) -> None:
        """Read the log once for the names of its interfaces. Raises BadArgument for several names."""
        begin, names = self._file.tell(), dict[str, None]()
        while line := self._file.readline(LINE_BYTES_MAX):
            match = _FRAME.fullmatch(line)
            if match is not None:
                names[_text(match[3])] = None
        self._file.seek(begin)
        if len(names) > 1:
            raise _several(names)
        self.interface, self._is_chosen = next(iter(names), ""), False

    def _is_own(self, interface: str) -> bool:
        """Return whether a frame is from the interface. Raises BadArgument for several interfaces without a choice."""
        if not self.interface:
            self.interface, self._is_chosen = interface, False
        if interface == self.interface:
            self._has_frames = True
            return True
        if not self._is_chosen:
            raise _several([self.interface, interface])
        if len(self._others) < INTERFACES_MAX:
            self._others[interface] = None
        return False

    def _time(self, log_ns: int, number: int) -> tuple[int, bool]:
        """Return the time of a frame, and whether the clock stepped before it."""
        self._kind.add(log_ns, number)
        if self._newest_ns is None:
            self._newest_ns = log_ns
        rise_ns = log_ns - self._newest_ns
        is_step = rise_ns < -DISORDER_NS or rise_ns >= STEP_NS
        if is_step or rise_ns >= PAUSE_NS:
            self._note_jump(rise_ns, number, "a step of the clock, removed by imud" if is_step else PAUSE)
        elif rise_ns < 0:
            self._note_jump(rise_ns, number, "lines in another order, or a short step of the clock")
        if is_step:
            self._offset_ns += rise_ns - max(self._distances_ns, default=0)
            self._newest_ns = log_ns
        elif rise_ns > 0:
            self._distances_ns.append(rise_ns)
            self._newest_ns = log_ns
        return self._newest_ns - self._offset_ns, is_step

    def _look_for_shift(self, can_id: int, t_ns: int, number: int) -> None:
        """Report a short step of the clock: backward shorter than the distance of two lines, forward like a pause."""
        times = self._times.get(can_id)
        if times is None:
            if len(self._times) < SHIFT_IDS:
                self._times[can_id] = _Times(t_ns)
        elif shift := times.add(t_ns, number):
            causes = SHIFT_FORWARD if shift[1] > 0 else SHIFT_BACKWARD
            self._note_jump(shift[1], shift[0], causes, "shifts")

    def _note_jump(self, rise_ns: int, number: int, what: str, verb: str = "changes") -> None:
        self._times.clear()  # all identifiers show the same step
        self._jump_count += 1
        if len(self._jumps) < JUMPS_SHOWN:
            digits = 3 if abs(rise_ns) >= NS_PER_MS else 6
            self._jumps.append(f"line {number}: the time {verb} by {rise_ns / NS_PER_S:+.{digits}f} s ({what})")

    def _note(self, line: bytes, number: int, *, passed: bool = False) -> None:
        if passed or _OTHER.fullmatch(line):
            self.passed_over += 1
        elif line.strip():
            self.bad_lines += 1
            self.first_bad = self.first_bad or number
