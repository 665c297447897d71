"""Copies of CAN frames: a gateway or a bridge delivers each frame again, up to some milliseconds later.

A device at rest sends equal frames at its period, and frames that waited in a queue arrive together. A short distance
and equal data therefore do not prove a copy. The proof is a frame with new data that arrives twice. A pair of different
frames at a short distance shows a queue, and ends the proof. A frame at an equal distance from its predecessors is
never a copy.

The first frame of a kind has no distance. If it arrives again after another kind, the burst of a device arrived twice,
or a device at rest sends faster than 333 Hz. imud ignores this one frame.
"""

from typing import Final, NamedTuple

from imud.model.units import NS_PER_MS

REPETITION_NS: Final = 2 * NS_PER_MS  # maximum time from a frame to its repetition by the bus, ns
COPY_NS: Final = 3 * NS_PER_MS  # maximum time from a frame to its copy, ns: a gateway needs 0.8 to 2 ms
UNKNOWN: Final = -1


class NewestFrame(NamedTuple):
    """Newest frame of a kind that is not a copy."""

    data: bytes
    t_ns: int  # arrival time
    pause_ns: int  # time from the previous arrival of this kind, copies included; UNKNOWN for the first frame
    is_new: bool  # whether the data differ from the previous frame


class FrameCopies:
    """Detection of copies among the frames of one device. Synchronization: one thread."""

    __slots__ = ("_arrival_ns", "_is_proven", "_kind", "_newest")

    def __init__(self) -> None:
        self._newest: dict[int, NewestFrame] = {}
        self._arrival_ns: dict[int, int] = {}  # time of the newest frame of each kind, copies included
        self._kind: int | None = None  # kind of the newest frame
        self._is_proven = False  # whether a frame with new data arrived twice

    def is_copy(self, kind: int, data: bytes, t_ns: int) -> bool:
        """Add a frame. Return whether it is a copy of the newest frame of its kind."""
        newest = self._newest.get(kind)
        arrival_ns = self._arrival_ns.get(kind)
        previous_kind = self._kind
        self._arrival_ns[kind] = t_ns
        self._kind = kind
        if newest is None or arrival_ns is None:
            self._newest[kind] = NewestFrame(data, t_ns, UNKNOWN, False)
            return False

        distance_ns = t_ns - newest.t_ns
        is_equal = data == newest.data
        if 0 < distance_ns < COPY_NS:
            if newest.pause_ns == UNKNOWN:
                if is_equal and arrival_ns == newest.t_ns and kind != previous_kind:
                    return True
            elif 2 * distance_ns <= newest.pause_ns:
                self._is_proven = is_equal and (self._is_proven or newest.is_new)
                if self._is_proven:
                    return True
        self._newest[kind] = NewestFrame(data, t_ns, t_ns - arrival_ns, not is_equal)
        return False

    def reset(self) -> None:
        """Forget the newest frames after lost frames."""
        self._newest.clear()
        self._arrival_ns.clear()
        self._kind = None
