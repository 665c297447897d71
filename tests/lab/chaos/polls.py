"""Requests and replies of polled devices, and the search for received samples in them.

A polled device makes a sample when it is read. The truth therefore has two sides: the deadlines, which follow the
period of the configuration from the first read, and the replies. An update of the device that no read saw is not a
sample. A value that is read twice before its update is one sample.
"""

import threading
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from enum import Enum
from itertools import pairwise
from time import monotonic_ns
from typing import Any, Final, NamedTuple

from imud.drivers.hipnuc.modbus.registers import BLOCK_REGISTERS
from imud.formats.modbus import READ_OVERHEAD_BYTES
from imud.model.sample import Sample
from imud.sim.imu61x.registers import Imu61xRegisters
from imud.sim.sensor import Burst
from tests.lab.chaos.account import Interval
from tests.lab.wire import Refuse

SEARCH_PART: Final = 2
"""imud reads a device immediately after its detection, and again at the first deadline: less than half a period
later."""
BLOCK_REPLY_BYTES: Final = READ_OVERHEAD_BYTES + 2 * BLOCK_REGISTERS


class Answer(Enum):
    GOOD = "good"
    DAMAGED = "damaged"
    REFUSED = "refused"
    ABSENT = "absent"
    """The level of a line without a driving device."""


class Asked(NamedTuple):
    t_ns: int
    """CLOCK_MONOTONIC between start and end of the transfer, ns."""
    answer: Answer
    is_sample: bool
    """True if the transfer requested a sample, False for identity and settings."""
    measured_ns: int
    """Time at which the device updated the values of the reply, ns."""


class PollLog:
    def __init__(self, period_ns: int) -> None:
        self.period_ns = period_ns
        self._asked: list[Asked] = []
        self._lock = threading.Lock()

    def add(self, asked: Asked) -> None:
        with self._lock:
            self._asked.append(asked)

    def between(self, begin_ns: int, end_ns: int) -> list[Asked]:
        with self._lock:
            first = bisect_right(self._asked, begin_ns, key=_time)
            return self._asked[first : bisect_right(self._asked, end_ns, key=_time)]

    def shown(self, begin_ns: int, end_ns: int) -> str:
        words = []
        for asked in self.between(begin_ns - 1, end_ns)[-40:]:
            word = f"{(asked.t_ns - begin_ns) / self.period_ns:.2f}:{asked.answer.value}"
            words.append(word if asked.is_sample else f"({word})")
        return " ".join(words)

    def strange(self, samples: Sequence[Sample]) -> list[int]:
        """Return `seq` of each sample from a read without a valid reply of the device."""
        with self._lock:
            times = [asked.t_ns for asked in self._asked if asked.is_sample and asked.answer is Answer.GOOD]
        return [s.seq for s in samples if bisect_left(times, s.t_ns) == bisect_right(times, s.t_rx_ns)]

    def troubles(self, begin_ns: int, end_ns: int) -> list[Interval]:
        """Return the times at which the device was missing or seemed to be missing, so that imud could search for
        it."""
        asked = self.between(begin_ns, end_ns)
        return [Interval(a.t_ns, a.t_ns, restarts=True) for a in asked if a.answer is not Answer.GOOD]

    def numbers_of(self, samples: Sequence[Sample], troubles: Sequence[Interval]) -> list[int]:
        """Return the number of each sample by deadlines, without the deadlines at which a value was read again.

        Between two troubles, the deadlines are one series whose reads are rarely late. After a trouble, another series
        starts.
        """
        numbers, begin = [0], 0
        for n, (before, after) in enumerate(pairwise(samples), 1):
            if any(trouble.touches(before, after) for trouble in troubles):
                numbers.append(numbers[-1] + self._steps(before, after, self.period_ns // SEARCH_PART))
                begin = n
            else:
                numbers.append(numbers[begin] + self._steps(samples[begin], after))
        return numbers[: len(samples)]

    def _steps(self, before: Sample, after: Sample, apart_ns: int = 0) -> int:
        """Return the number of deadlines between two samples. Reads less than `apart_ns` apart share a deadline."""
        asked = self.between(before.t_ns - 1, after.t_rx_ns)
        good = [a for a in asked if a.is_sample and a.answer is Answer.GOOD]
        stale = sum(a.measured_ns == b.measured_ns and b.t_ns - a.t_ns >= apart_ns for a, b in pairwise(good))
        return round((after.t_ns - before.t_ns) / self.period_ns) - stale


class LoggedRegisters:
    def __init__(self, period_ns: int) -> None:
        self.device = Imu61xRegisters(monotonic_ns)
        self.log = PollLog(period_ns)

    def logged(self, answer: Callable[[Any], bytes], is_sample: Callable[[Any], bool]) -> Callable[[Any], bytes]:
        """Return the device in the form of the bus. `is_sample` returns whether a transfer requests a sample."""

        def logging(transfer: Any) -> bytes:
            device, got, t_ns = self.device, Answer.GOOD, monotonic_ns()
            flips = device.faults.flips
            try:
                data = answer(transfer)
            except Refuse:
                got = Answer.REFUSED
                raise
            else:
                if device.faults.line is not None:
                    got = Answer.ABSENT
                elif device.faults.flips < flips:
                    got = Answer.DAMAGED
                return data
            finally:
                self.log.add(Asked(t_ns, got, is_sample(transfer), device.latched_ns))

        return logging


def block_replies(log: PollLog) -> Callable[[Burst, int], None]:
    """Return a function that logs the replies with a sample of a device on RS-485."""

    def add(reply: Burst, _power_ns: int) -> None:
        if reply.sample_ns is not None and len(reply.data) == BLOCK_REPLY_BYTES:
            log.add(Asked(monotonic_ns(), Answer.GOOD, True, reply.sample_ns))  # the device time can be one step old

    return add


def _time(asked: Asked) -> int:
    return asked.t_ns
