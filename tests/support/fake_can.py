"""A small CAN protocol for tests: a device of node n sends 0x180 + n, eight bytes, each frame a sample."""

from collections.abc import Sequence
from typing import Annotated, Final

from msgspec import Meta

from imud.contracts.action import Action
from imud.contracts.can import CanDriver
from imud.contracts.codec import CodecEvent
from imud.contracts.driver import SAMPLE_COUNTER, Identity
from imud.contracts.session import says_nothing
from imud.contracts.settings import Settings
from imud.formats.can import STANDARD_ID_MAX, CanFilter, CanFrame, CyclicFrame
from imud.ledger import Ledger
from imud.sample import Measurement

BASE: Final = 0x180
SYNC_ID: Final = 0x080


class FakeCanSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Which device, and whether it wants a SYNC."""

    node: Annotated[int, Meta(ge=1, le=127)] = 1
    sync_ms: int = 0


class FakeCanCodec:
    """Every own frame is a sample, numbered by its first byte, but for those that begin with 0xFF."""

    def __init__(self, ledger: Ledger, settings: FakeCanSettings) -> None:
        self.ledger = ledger
        self._can_id = BASE + settings.node

    def feed_frame(self, can_id: int, extended: bool, data: bytes, t_rx_ns: int) -> Sequence[CodecEvent]:
        """One frame."""
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
        """Nothing waits."""
        return ()

    def reset(self) -> None:
        """Nothing waits."""


def _cyclic(settings: FakeCanSettings) -> Sequence[CyclicFrame]:
    return [CyclicFrame(SYNC_ID, False, b"", settings.sync_ms * 1_000_000)] if settings.sync_ms else []


def fake_can_driver(name: str = "fake-can", base: int = BASE) -> CanDriver:
    """A row; another `base` makes it see devices that its codec does not understand."""
    return CanDriver(
        name=name,
        title="a fake",
        settings=FakeCanSettings,
        make_codec=FakeCanCodec,
        filters=lambda settings: [CanFilter(BASE + settings.node, STANDARD_ID_MAX, False)],
        tick_ns=SAMPLE_COUNTER,
        tick_modulus=0xFF,
        euler_convention="",
        navigation_frame="",
        node_of=lambda can_id, extended, data: (
            can_id - base if base < can_id <= base + 127 and not extended and len(data) == 8 else None
        ),
        node_settings=lambda node: FakeCanSettings(node=node),
        node_title=lambda node: f"node {node}",
        identify=lambda _settings: says_nothing(Identity("FAKE")),
        read_settings=lambda _settings: says_nothing({}),
        apply_identity=lambda _codec, _identity: None,
        sample_frames=1,
        example_frames=lambda _random: [CanFrame(BASE + 1, False, bytes(8), 0)],
        cyclic=_cyclic,
        actions={"node": Action("its number", lambda target, _params: says_nothing(target.settings.node))},
    )


def fake_frame(node: int, number: int = 0, t_ns: int = 0) -> CanFrame:
    """A frame of a device; number 255 is one that is no sample."""
    return CanFrame(BASE + node, False, bytes([number, *bytes(7)]), t_ns)
