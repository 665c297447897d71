"""Topics that the sender must not send now: the broker refuses them, or they have no subscriber."""

from collections.abc import Collection, Mapping
from typing import Final, NamedTuple

from imud.model.units import NS_PER_S

# Number of lost connections in sequence with only one topic in flight, after which imud skips the topic
LOSSES_MAX: Final = 3
# Time for which imud skips a refused topic, ns. It doubles with each further refusal: a test can cost a connection.
SKIP_NS: Final = 60 * NS_PER_S
SKIP_MOST_NS: Final = 3600 * NS_PER_S
# Maximum number of refused topics, of suspected topics, and of topics with a subscriber. imud forgets the oldest.
TOPICS_MAX: Final = 500
# Time for which imud keeps messages without a subscriber if their topic had a subscriber before, ns. After a restart, a
# broker can have no subscription until the collectors connect again.
UNCLAIMED_NS: Final = 300 * NS_PER_S
UNCLAIMED_SKIP_NS: Final = 10 * NS_PER_S  # time between two tests of such a topic, ns
LOSS_ADVICE: Final = "; check the access rights of the gateway, and the size limit of the broker"


def is_subscription(topic: str) -> bool:
    """Return whether a topic is the filter of the subscription. A message cannot have a topic with a wildcard."""
    return "+" in topic


class _Refusal(NamedTuple):
    """Refusal of a topic."""

    problem: str  # reason of the refusal, one sentence
    skip_ns: int  # time for which imud skips the topic
    end_ns: int  # CLOCK_MONOTONIC of the next test


class TopicRefusals:
    """Topics that the broker refuses, and suspected topics. Synchronization: the caller holds its lock.

    The filter of the subscription is one of the topics: a broker can also refuse the subscription.

    A broker refuses a message with a reason code (MQTT 5), or it closes the connection. In the second case several
    messages can be in flight. The sender then sends the next message of each of these topics alone. A topic is refused
    if the connection was lost LOSSES_MAX times while only messages of this topic were in flight.
    """

    def __init__(self) -> None:
        self._suspects: dict[str, int] = {}  # number of connections that were lost while only this topic was in flight
        self._refused: dict[str, _Refusal] = {}
        self._skipped: dict[str, None] = {}  # refused topics whose time has not ended

    @property
    def skipped(self) -> Collection[str]:
        """Return the topics that imud must not send now."""
        return self._skipped.keys()

    @property
    def problems(self) -> Mapping[str, str]:
        """Return the reason for each refused topic. The broker has not accepted a message of the topic since then."""
        return {topic: refusal.problem for topic, refusal in self._refused.items()}

    def is_suspect(self, topic: str) -> bool:
        """Return whether a message of the topic must be the only message in flight."""
        return topic in self._suspects

    def losses(self, topic: str) -> int:
        return self._suspects.get(topic, 0)

    def refuse(self, topic: str, problem: str, now_ns: int, skip_ns: int | None = None) -> None:
        """Skip a topic for `skip_ns`, because the broker refused a message; None: for a time that grows with each
        refusal. Do nothing for a skipped topic."""
        if topic in self._skipped:
            return
        if is_subscription(topic):
            problem += "; commands over MQTT do not work"
        known = self._refused.pop(topic, None)
        if skip_ns is None:
            skip_ns = SKIP_NS if known is None else min(2 * known.skip_ns, SKIP_MOST_NS)
        self._suspects.pop(topic, None)
        self._refused[topic] = _Refusal(problem, skip_ns, now_ns + skip_ns)
        self._skipped[topic] = None
        while len(self._refused) > TOPICS_MAX:
            oldest = next(iter(self._refused))
            del self._refused[oldest]
            self._skipped.pop(oldest, None)

    def accept(self, topic: str) -> None:
        """Forget a refusal, because the broker acknowledged a message of the topic."""
        self._suspects.pop(topic, None)
        self._refused.pop(topic, None)
        self._skipped.pop(topic, None)

    def lose(self, in_flight: Collection[str], problem: str, now_ns: int) -> None:
        """Suspect the topics of all messages in flight, because the connection was lost."""
        topics = dict.fromkeys(topic for topic in in_flight if topic not in self._skipped)
        for topic in topics:
            losses = self._suspects.setdefault(topic, 0) + (len(topics) == 1)
            self._suspects[topic] = losses
            if losses >= LOSSES_MAX:
                packet = "the subscription" if is_subscription(topic) else "a message"
                self.refuse(topic, f"{problem}, {losses} times after {packet} of this topic{LOSS_ADVICE}", now_ns)
        while len(self._suspects) > TOPICS_MAX:
            del self._suspects[next(iter(self._suspects))]

    def take_ended(self, now_ns: int) -> list[str]:
        """Return the topics whose time has ended. One further loss refuses them again."""
        ended = [topic for topic in self._skipped if self._refused[topic].end_ns <= now_ns]
        for topic in ended:
            del self._skipped[topic]
            self._suspects[topic] = LOSSES_MAX - 1
        return ended


class TopicSubscribers:
    """Topics that had a subscriber since the start. Synchronization: one thread."""

    def __init__(self) -> None:
        # with the time of the first message without a subscriber after that
        self._topics: dict[str, int | None] = {}

    def note(self, topic: str) -> None:
        """Store that a message of the topic had a subscriber."""
        self._topics.pop(topic, None)
        self._topics[topic] = None
        if len(self._topics) > TOPICS_MAX:
            del self._topics[next(iter(self._topics))]

    def are_expected(self, topic: str, now_ns: int) -> bool:
        """Return whether imud keeps a message without a subscriber: for UNCLAIMED_NS after the first one, if the topic
        had a subscriber before."""
        if topic not in self._topics:
            return False
        begin_ns = self._topics[topic]
        if begin_ns is None:
            begin_ns = self._topics[topic] = now_ns
        if now_ns - begin_ns > UNCLAIMED_NS:
            del self._topics[topic]
            return False
        return True
