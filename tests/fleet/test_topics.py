"""Refused topics and topics with a subscriber: their numbers and times are limited."""

from imud.fleet.commands import CommandReply
from imud.fleet.topics import SKIP_NS, TOPICS_MAX, TopicRefusals
from imud.model.units import NS_PER_S
from tests.fleet.test_sender import LOSSES_MAX, SenderBench, row


def test_the_number_of_refused_topics_is_limited() -> None:
    refusals = TopicRefusals()
    for number in range(TOPICS_MAX + 1):
        refusals.refuse(f"t{number}", "no", 0)
    refusals.refuse("t1", "a skipped topic keeps its reason", 1)
    assert (len(refusals.problems), *refusals.skipped) == (TOPICS_MAX, *(f"t{n + 1}" for n in range(TOPICS_MAX)))
    assert set(refusals.problems.values()) == {"no"}
    assert (len(refusals.take_ended(SKIP_NS)), refusals.losses("t1")) == (TOPICS_MAX, LOSSES_MAX - 1)
    refusals, now_ns = TopicRefusals(), 0
    for skip_s in (60, 120, 240, 480, 960, 1920, 3600, 3600):
        refusals.refuse("t", "no", now_ns)
        now_ns += skip_s * NS_PER_S
        assert (refusals.take_ended(now_ns - 1), refusals.take_ended(now_ns)) == ([], ["t"])
    (bench := SenderBench()).broker.refuses, bench.broker.window = {"answer"}, 1
    for _ in range(3):
        bench.sender.reply(CommandReply("answer", b"", None))
    bench.drive(3)
    assert bench.sender.replies_lost == 3, "one is refused, and two wait for the same topic"


def test_the_number_of_topics_with_a_subscriber_is_limited() -> None:
    bench = SenderBench()
    bench.drive(1)
    for number in range(TOPICS_MAX + 1):
        bench.sender.give(1, [row(number + 1, topic=f"data/{number}")])
        bench.drive(1)
    bench.broker.unclaimed = {"data/0", "data/1"}
    bench.sender.give(1, [row(1001, topic="data/0"), row(1002, topic="data/1")])
    bench.drive(2)
    assert bench.sender.refused.keys() == {"data/1"}, "imud has forgotten the oldest topic"
    assert bench.done >= {1001}
