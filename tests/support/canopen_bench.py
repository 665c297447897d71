"""Conversations with a simulated CANopen module, without a bus: frames are handed over in simulated time."""

from collections.abc import Callable
from typing import TypeVar

from imud.contracts.codec import message_of
from imud.contracts.session import Outcome, Reply, Request, RequestScript, Session
from imud.devices.hipnuc.canopen.codec import HipnucCanopenCodec, HipnucCanopenSettings
from imud.formats.can import EXTENDED_FLAG, RAW_FRAME
from imud.ledger import Ledger
from imud.sample import Measurement
from imud.sim.hipnuc.canopen import HipnucCanopenHardware, HipnucCanopenModule, NodeSettings

T = TypeVar("T")

BEGIN_NS = 5_000_000_000
STEP_NS = 250_000
MS = 1_000_000
QUIET = NodeSettings(periods_ms=dict.fromkeys((1, 2, 3, 4, 6, 7), 0))


def unpack(payload: bytes) -> tuple[int, bytes]:
    """Identifier and data of a packed standard frame."""
    can_id, size, data = RAW_FRAME.unpack(payload)
    assert can_id < EXTENDED_FLAG
    return can_id, data[:size]


class Bench:
    """A module, a codec that hears it, and a session."""

    def __init__(self, factory: NodeSettings | None = None, boot_ms: int = 0) -> None:
        self.now_ns = BEGIN_NS
        hardware = HipnucCanopenHardware(factory=factory or QUIET, boot_ms=boot_ms, skew_ppm=0)
        self.module = HipnucCanopenModule(BEGIN_NS, hardware)
        self.codec = HipnucCanopenCodec(Ledger(), HipnucCanopenSettings(node=self.module.node))
        self.session = Session(self.codec.ledger)
        self.sent: list[tuple[int, bytes]] = []
        """What the host sent."""
        self.heard: list[tuple[int, bytes]] = []
        """What the module sent."""
        self.measured: list[Measurement] = []

    def run(self, duration_ns: int) -> Outcome | None:
        """Let time pass, up to the end of the outstanding request."""
        end_ns = self.now_ns + duration_ns
        while self.now_ns < end_ns:
            self.now_ns += STEP_NS
            for frame in self.module.advance(self.now_ns):
                self.heard.append((frame.can_id, frame.data))
                for event in self.codec.feed_frame(frame.can_id, frame.extended, frame.data, frame.due_ns):
                    if isinstance(event, Measurement):
                        self.measured.append(event)
                    message = message_of(event)
                    outcome = self.session.on_message(message, self.now_ns) if message is not None else None
                    if outcome is not None:
                        return outcome
            silence = self.session.on_time(self.now_ns)
            if silence is not None:
                return silence
        return None

    def send(self, can_id: int, data: bytes) -> None:
        """A frame of the host."""
        self.sent.append((can_id, data))
        self.module.receive(can_id, False, data, self.now_ns)

    def hold(self, conversation: RequestScript[T]) -> T:
        """Run a conversation to its end."""
        return converse(conversation, self._ask)

    def _ask(self, request: Request) -> Outcome:
        payload = self.session.start(request, self.now_ns)
        if payload:
            self.send(*unpack(payload))
        if request.silent:
            return Reply(())
        outcome = self.run(request.timeout_ns + 2 * STEP_NS)
        assert outcome is not None
        return outcome


def converse(conversation: RequestScript[T], ask: Callable[[Request], Outcome]) -> T:
    """Run a conversation to its end with what `ask` makes of its requests."""
    try:
        request = next(conversation)
        while True:
            request = conversation.send(ask(request))
    except StopIteration as end:
        value: T = end.value
        return value
