"""Broker in memory for tests of the sender. The test decides when it acknowledges and when it fails."""

import threading
from collections.abc import Callable

from imud.fleet.broker import RIGHTS, BrokerError, MessageRefused, Received, RetainRefused, Will
from imud.fleet.settings import Broker, MqttOptions
from imud.model.work_budget import WorkBudget
from tests.support.daemon_process import LIMIT_S


class FakeConnection:
    def __init__(self, broker: "FakeBroker") -> None:
        self.acknowledged: list[int] = []
        self.unclaimed: set[int] = set()
        self.in_flight_max = broker.window
        self.received: list[Received] = []
        self.refused: list[tuple[int, str]] = []
        self.has_retain = broker.has_retain
        self.budget: WorkBudget | None = None
        self.packets: list[str] = []  # topic of each message and subscription
        self.correlations: list[bytes | None] = []
        self.sent: list[tuple[str, bytes, bool]] = []
        self.types: list[str] = []
        self.closed = False
        self.rings = 0
        self._bell = threading.Event()
        self._broker = broker
        self._answered = 0

    def subscribe(self, topic: str) -> int:
        self.packets.append(topic)
        return len(self.packets)

    def publish(
        self, topic: str, payload: bytes, content_type: str, *, retain: bool, correlation: bytes | None = None
    ) -> int:
        if topic in self._broker.rejects:
            raise MessageRefused("Not authorized")
        self.correlations.append(correlation)
        self.sent.append((topic, payload, retain))
        self.packets.append(topic)
        self.types.append(content_type)
        with self._broker.changed:
            self._broker.changed.notify_all()
        return len(self.packets)

    def wait(self, seconds: float) -> None:
        """Acknowledge messages if the test allows it. Raise BrokerError if the broker has a problem."""
        if self._broker.problem:
            raise BrokerError(self._broker.problem)
        while self._answered < len(self.packets) and self._broker.answers > 0:
            self._broker.answers -= 1
            self._answered += 1
            topic = self.packets[self._answered - 1]
            if topic in self._broker.closes_on:
                raise BrokerError("the connection was lost")
            if topic in self._broker.refuses:
                self.refused.append((self._answered, f"Not authorized{RIGHTS}"))
            elif topic not in self._broker.ignores:
                self.acknowledged.append(self._answered)
                if topic in self._broker.unclaimed:
                    self.unclaimed.add(self._answered)
        if self._broker.blocks and not self.acknowledged:
            self._bell.wait(seconds)
            self._bell.clear()

    def ring(self) -> None:
        self.rings += 1
        self._bell.set()

    def close(self) -> None:
        self.closed = True


class FakeBroker:
    """Broker in memory. `connect` is a `Connect`. With `blocks`, `wait` of a connection really waits."""

    def __init__(self, *, blocks: bool = False) -> None:
        self.blocks = blocks
        self.changed = threading.Condition()
        self.connections: list[FakeConnection] = []
        self.asked: list[str] = []
        self.problem = ""  # problem of every connection; empty if the broker works
        self.answers = 1_000_000  # number of remaining acknowledgements
        self.window = 4
        self.closes_on: set[str] = set()  # topics for which the broker closes the connection
        self.refuses: set[str] = set()  # topics that the broker refuses with a reason
        self.unclaimed: set[str] = set()  # topics without a subscriber
        self.ignores: set[str] = set()  # topics that the broker never acknowledges
        self.rejects: set[str] = set()  # topics whose messages are too long for the broker
        self.will: Will | None = None
        self.permits_will = True
        self.has_retain = True  # whether the broker permits retained messages
        self.connecting, self.accepts = threading.Event(), threading.Event()
        self.accepts.set()
        self.was_wanted = True  # result of `is_wanted` at the newest connection

    def connect(
        self, broker: Broker, _settings: MqttOptions, _client_id: str, will: Will | None, is_wanted: Callable[[], bool]
    ) -> FakeConnection:
        """Accept or reject a connection. Wait for `accepts` first."""
        self.asked.append(broker.host)
        self.will = will
        self.connecting.set()
        assert self.accepts.wait(LIMIT_S)
        self.was_wanted = is_wanted()
        if self.problem:
            raise BrokerError(self.problem)
        if will is not None and not self.permits_will:
            raise RetainRefused("Retain not supported")
        self.connections.append(FakeConnection(self))
        return self.connections[-1]

    def wait_for(self, topic: str, holds: Callable[[bytes], bool] = lambda payload: True) -> None:
        """Wait until the sender sent a message of the topic for which `holds` returns True."""
        with self.changed:
            assert self.changed.wait_for(
                lambda: any(sent[0] == topic and holds(sent[1]) for one in self.connections
                            for sent in one.sent), LIMIT_S
            )  # fmt: skip
