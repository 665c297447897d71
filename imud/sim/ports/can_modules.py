"""Several simulated devices on one CAN bus, as one: what each sends, the others hear."""

from collections.abc import Sequence
from heapq import merge

from imud.sim.can_module import CanModule, SentFrame


class CanModules:
    """Modules that share a bus, in the shape of a single one (`CanModule`). Synchronization: one thread."""

    def __init__(self, modules: Sequence[CanModule]) -> None:
        """Raises ValueError without any module."""
        if not modules:
            raise ValueError("expected at least one module")
        self.modules = tuple(modules)
        self.epoch_ns = modules[0].epoch_ns

    def receive(self, can_id: int, extended: bool, data: bytes, now_ns: int) -> None:
        """Every module hears it."""
        for module in self.modules:
            module.receive(can_id, extended, data, now_ns)

    def advance(self, now_ns: int) -> list[SentFrame]:
        """What has crossed the wire since the last call; frames of the same moment in the order of the modules."""
        sent = [module.advance(now_ns) for module in self.modules]
        for sender, frames in zip(self.modules, sent, strict=True):
            for frame in frames:
                self._others_hear(sender, frame, now_ns)
        return list(merge(*sent, key=lambda frame: frame.due_ns))

    def next_ns(self) -> int | None:
        """When the first of them will have something next."""
        return min((due_ns for module in self.modules if (due_ns := module.next_ns()) is not None), default=None)

    def counters(self) -> dict[str, int]:
        """The sums of what they count."""
        total: dict[str, int] = {}
        for module in self.modules:
            for name, value in module.counters().items():
                total[name] = total.get(name, 0) + value
        return total

    def mark(self, now_ns: int) -> None:
        """The sync inputs of all are wired together."""
        for module in self.modules:
            module.mark(now_ns)

    def reboot(self, now_ns: int) -> None:
        """All of them lose power."""
        for module in self.modules:
            module.reboot(now_ns)

    def _others_hear(self, sender: CanModule, frame: SentFrame, now_ns: int) -> None:
        for module in self.modules:
            if module is not sender:
                module.receive(frame.can_id, frame.extended, frame.data, now_ns)
