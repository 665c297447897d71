"""The samples that one read of one device completed, with each encoding made at most once for all who want it."""

from collections.abc import Sequence

from imud.formats.slot import encode_slot
from imud.sample import Sample


class Batch:
    """One or more samples of one device, oldest first. Publishers share it and must not change it."""

    __slots__ = ("_slots", "device", "device_id", "samples")

    def __init__(self, device: str, device_id: int, samples: Sequence[Sample]) -> None:
        self.device = device
        self.device_id = device_id
        """The daemon's number of the device, as it stands in slots."""
        self.samples = samples
        self._slots: list[bytes] | None = None

    def slots(self) -> list[bytes]:
        """The samples as slots (`imud.formats.slot`), encoded on first use."""
        if self._slots is None:
            device_id = self.device_id
            self._slots = [encode_slot(sample, device_id) for sample in self.samples]
        return self._slots
