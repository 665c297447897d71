"""Sender: window of messages, retained messages first, and all messages again in order after a lost connection."""

import threading
from unittest.mock import Mock

import pytest

from imud.fleet.broker import BROKER_LIMITS, LOST, BrokerTurn, Received, Will
from imud.fleet.commands import CommandChannel, CommandReply
from imud.fleet.messages import JSON_TYPE, MAGIC, SLOTS_TYPE
from imud.fleet.sender import NO_RETAIN, MqttSender
from imud.fleet.settings import Broker, CommandOptions, MqttOptions
from imud.fleet.spool import SpoolRow
from imud.fleet.streams import Gateway
from imud.fleet.topics import UNCLAIMED_NS, UNCLAIMED_SKIP_NS
from imud.model.units import NS_PER_S
from imud.model.work_budget import WorkBudget
from tests.fleet.fake_broker import FakeBroker
from tests.support.daemon_process import LIMIT_S
from tests.support.event_loops import VirtualClock

STABLE_NS, LOSSES_MAX, OUTBOX_MAX, REPLIES_MAX = 30 * NS_PER_S, 3, 60, 32


def row(number: int, payload: bytes = b"{}", topic: str = "topic") -> SpoolRow:
    return SpoolRow(number, "1", "bow", "samples", "samples", topic, number, number, 1, 0, payload)


class SenderBench:
    def __init__(self, *hosts: str) -> None:
        self.broker, self.clock = FakeBroker(), VirtualClock()
        turn = BrokerTurn([Broker(host, 1, False, False, "") for host in hosts or ("a",)], 60.0, lambda: 0.5)
        will = Will("state", b"gone")
        self.sender = MqttSender(MqttOptions(), "me", will, turn, self.broker.connect, self.clock.now_ns)
        self.wanted, self.done = 0, set[int]()
        self.sender.wanting = self._want

    def _want(self) -> None:
        self.wanted += 1

    def drive(self, turns: int, rows: list[SpoolRow] | None = None) -> None:
        """Let the sender work. Give it all rows without an acknowledgement at each new session, as the writer does."""
        session = 0
        for _ in range(turns):
            self.clock.advance(round((self.sender.work() + 0.1) * NS_PER_S))
            self.done |= {number for _, number in self.sender.take_acknowledged()}
            if rows and self.sender.session != session and self.sender.connected:
                session = self.sender.session
                self.sender.give(session, [one for one in rows if one.id not in self.done])

    def sent(self) -> list[bytes]:
        return [payload for _, payload, _ in self.broker.connections[-1].sent]


def test_messages_are_sent_in_order_within_the_window() -> None:
    bench = SenderBench()
    bench.broker.answers = 0
    assert bench.sender.room() == 0
    assert bench.sender.work() == 0
    assert bench.sender.room() == OUTBOX_MAX
    bench.sender.give(bench.sender.session, [row(n, b"%d" % n) for n in range(1, 7)])
    bench.sender.work()
    assert bench.sent() == [b"1", b"2", b"3", b"4"]
    assert bench.sender.room() == OUTBOX_MAX - 6
    bench.broker.answers = 2
    bench.sender.work()
    bench.sender.work()
    assert bench.sent() == [b"1", b"2", b"3", b"4", b"5", b"6"]
    assert bench.sender.take_acknowledged() == [(1, 1), (1, 2)]
    assert bench.sender.take_acknowledged() == []
    assert bench.broker.connections[0].rings == 1
    bench.sender.retain({})
    assert bench.broker.connections[0].rings == 2, "each change wakes the connection"
    assert (bench.sender.sent, bench.sender.acknowledged) == (6, 2)
    assert bench.broker.connections[0].types == [JSON_TYPE] * 6
    bench.sender.give(bench.sender.session, [row(7, MAGIC + b"x")])
    bench.broker.answers = 6
    bench.sender.work()
    bench.sender.work()
    assert bench.broker.connections[0].types[6:] == [SLOTS_TYPE]
    bench.sender.reply(CommandReply("answer", b"", None))
    bench.sender.close(b"bye")
    assert bench.broker.connections[0].rings == 5


@pytest.mark.parametrize(("stable", "problem"), [(False, LOST), (True, LOST), (False, "the broker sent QoS 2")])
def test_connections_that_are_lost_soon_name_a_gateway_with_the_same_name(stable: bool, problem: str) -> None:
    bench, problems = SenderBench(), list[str]()
    for number in range(4):
        bench.broker.problem = ""
        bench.sender.work()
        bench.clock.advance(STABLE_NS if stable and number == 1 else STABLE_NS - 1)
        bench.broker.problem = problem
        bench.sender.work()
        problems.append(bench.sender.problem)
    named = "the connection was lost; does another gateway use the client ID me (mqtt.gateway)?"
    assert problems == [problem] * 2 + [problem if stable or problem != LOST else named] * 2


def test_a_lost_connection_clears_the_outbox_and_starts_a_new_session() -> None:
    bench = SenderBench("a", "b")
    bench.broker.answers = 1
    bench.sender.work()
    bench.sender.give(1, [row(1), row(2)])
    bench.sender.work()
    bench.broker.problem, bench.wanted = "the cable was pulled", 0
    assert (bench.sender.work(), bench.wanted) == (2.0, 1)
    assert bench.broker.connections[0].closed
    assert (bench.sender.connected, bench.sender.problem, bench.sender.session) == (False, "the cable was pulled", 2)
    assert bench.sender.take_acknowledged() == [(1, 1)]
    bench.sender.give(1, [row(3)])
    assert bench.sender.work() > 0
    bench.broker.problem = ""
    bench.sender.work()
    bench.sender.work()
    assert bench.sent() == []
    assert ((bench.sender.problem, bench.sender.reconnects), bench.broker.asked) == (("", 1), ["a", "a", "b"])


def test_retained_messages_are_sent_first_at_each_connection() -> None:
    bench = SenderBench()
    bench.sender.retain({"state": b"born", "status": b"1"})
    bench.sender.work()
    bench.sender.give(1, [row(1, b"data")])
    bench.sender.work()
    sent = bench.broker.connections[0].sent
    assert sent == [("state", b"born", True), ("status", b"1", True), ("topic", b"data", False)]
    bench.sender.retain({"status": b"1"})
    bench.sender.work()
    assert len(bench.sent()) == 3, "what is the same is not sent again"
    bench.broker.answers = 0
    bench.sender.retain({"status": b""})
    bench.sender.work()
    assert bench.sent()[3:] == [b""]
    bench.broker.problem = "gone"
    bench.sender.work()
    bench.broker.problem, bench.broker.answers = "", 9
    bench.drive(4)
    assert bench.sent() == [b"born", b""], "the broker did not acknowledge the removal"
    bench.broker.problem = "gone"
    bench.sender.work()
    bench.broker.problem = ""
    bench.sender.work()
    bench.sender.work()
    assert bench.sent() == [b"born"], "what was removed is not sent again"


@pytest.mark.live
def test_the_sender_ends_with_a_farewell() -> None:
    bench, connected = SenderBench(), threading.Event()
    bench.sender.wanting = connected.set
    bench.sender.start()
    assert connected.wait(LIMIT_S)
    bench.sender.close(b"bye")
    bench.sender.close(b"bye")
    assert bench.broker.connections[-1].sent[-1] == ("state", b"bye", True)
    assert bench.broker.connections[-1].closed
    assert bench.sender.failure is None


@pytest.mark.live
def test_a_connection_that_completes_after_the_end_sends_nothing() -> None:
    """The next output uses the same client ID and may already be connected."""
    bench = SenderBench()
    bench.broker.accepts.clear()
    bench.sender.retain({"state": b"born"})
    bench.sender.start()
    assert bench.broker.connecting.wait(LIMIT_S)
    bench.sender.close(b"bye")
    bench.broker.accepts.set()
    bench.sender.join(LIMIT_S)
    (connection,) = bench.broker.connections
    assert not bench.broker.was_wanted
    assert (connection.sent, connection.closed, bench.sender.connected) == ([], True, False)
    assert bench.broker.asked == ["a"], "it does not try again"


def test_replies_without_acknowledgement_are_sent_again_up_to_a_limit() -> None:
    bench = SenderBench()
    bench.broker.answers = 1
    bench.sender.work()
    for number in range(3):
        bench.sender.reply(CommandReply("answer", b"%d" % number, b"c"))
    bench.sender.work()
    assert bench.sent() == [b"0", b"1", b"2"]
    bench.broker.problem = "the cable was pulled"
    bench.sender.work()
    bench.sender.reply(CommandReply("answer", b"3", None))
    bench.broker.problem, bench.broker.answers = "", 100
    bench.drive(5)
    assert bench.sent() == [b"1", b"2", b"3"]
    assert bench.broker.connections[-1].correlations == [b"c", b"c", None]
    assert not any(retained for _, _, retained in bench.broker.connections[-1].sent)
    bench = SenderBench()
    bench.broker.window, bench.broker.answers = 1000, 0
    bench.sender.work()
    for number in range(10):
        bench.sender.reply(CommandReply("answer", b"%d" % number, None))
    bench.sender.work()
    bench.broker.problem = "the cable was pulled"
    for number in range(10, REPLIES_MAX + 5):
        bench.sender.reply(CommandReply("answer", b"%d" % number, None))
    bench.sender.work()
    bench.broker.problem, bench.broker.answers = "", 100
    bench.drive(REPLIES_MAX + 2)
    assert bench.sent() == [b"%d" % number for number in range(5, REPLIES_MAX + 5)]
    assert bench.sender.replies_lost == 5
    bench.broker.refuses = {"answer"}
    for number in range(3):  # refused, and discarded before the end of the refusal
        bench.sender.reply(CommandReply("answer", b"%d" % number, None))
        bench.drive(3)
    assert bench.sender.replies_lost == 8


LONG_NS = 600 * NS_PER_S  # longer than the pauses of this test
FORBIDDEN = {"ha/a", "ha/b", "data/x", "answer/x"}
REQUESTS = "imud/s/gw/+/command"


@pytest.mark.parametrize(
    ("topic", "words"),
    [
        (REQUESTS, f"the subscription to {REQUESTS} within 4 s, got none; commands over"),
        ("data/x", "a message of data/x"),
    ],
)
def test_one_missing_acknowledgement_among_others_is_named(topic: str, words: str) -> None:
    bench = SenderBench()
    bench.sender.commands = CommandChannel(CommandOptions(), Gateway("s", "gw", ""), Mock(), bench.clock.now_ns, Mock())
    bench.broker.ignores = {topic}
    bench.drive(1)
    for number in range(60):
        bench.sender.give(1, [row(number + 2, topic="data/y"), *[row(1, topic="data/x")] * (number == 0)])
        bench.drive(1)
    assert f"expected an acknowledgement of {words}" in bench.sender.problem
    assert (len(bench.done), bench.sender.connected) == (60 + (topic == REQUESTS), True)


@pytest.mark.parametrize("way", ["closes_on", "refuses", "rejects"])
def test_forbidden_topics_do_not_block_other_messages(way: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("imud.fleet.topics.SKIP_NS", LONG_NS)
    bench = SenderBench()
    bench.sender.commands = CommandChannel(CommandOptions(), Gateway("s", "gw", ""), Mock(), bench.clock.now_ns, Mock())
    forbidden = FORBIDDEN if way == "rejects" else FORBIDDEN | {REQUESTS}
    setattr(bench.broker, way, forbidden)
    rows = [row(n, b"%d" % n, "data/x" if n % 3 == 0 else f"data/{n % 3}") for n in range(1, 31)]
    bench.sender.retain({"ha/a": b"1", "state": b"2", "ha/b": b"3", "status": b"4"})
    bench.drive(1)
    bench.sender.reply(CommandReply("answer/x", b"", None))
    bench.sender.reply(CommandReply("answer/y", b"", None))
    bench.drive(100, rows)
    assert bench.done == {one.id for one in rows if one.topic != "data/x"}
    sent = [topic for one in bench.broker.connections for topic, _, _ in one.sent]
    assert {"state", "status", "answer/y"} <= set(sent)
    assert bench.sender.skipped == set(bench.sender.refused) == forbidden
    assert all("lost" in one or one.startswith("Not authorized") for one in bench.sender.refused.values())
    assert way == "rejects" or "commands over MQTT do not work" in bench.sender.refused[REQUESTS]
    losses = len(bench.broker.connections) - 1
    assert losses <= (3 + LOSSES_MAX * len(forbidden) if way == "closes_on" else 0)
    assert bench.sender.connected
    bench.sender.retain({"ha/a": b"5"})
    bench.sender.reply(CommandReply("answer/x", b"", None))
    bench.drive(5)
    assert len(bench.broker.connections) - 1 == losses, "imud does not send skipped topics"
    setattr(bench.broker, way, {"ha/b"})
    bench.clock.advance(LONG_NS)
    bench.drive(50, rows)
    assert bench.sender.skipped == set(bench.sender.refused) - {"answer/x"} == {"ha/b"}
    assert bench.done == {one.id for one in rows}
    assert ("ha/a", b"5", True) in [one for made in bench.broker.connections for one in made.sent]
    assert REQUESTS in bench.broker.connections[-1].packets


def test_lost_connections_refuse_no_innocent_topic_and_a_silent_broker_is_left() -> None:
    bench = SenderBench()
    for number in range(1, 20):
        bench.broker.problem, bench.broker.answers = "", 0
        bench.sender.work()
        bench.sender.give(bench.sender.session, [row(2 * number), row(2 * number + 1, topic="other")])
        bench.sender.work()
        bench.broker.answers = 9
        bench.drive(3)
        bench.broker.answers = 0
        bench.sender.give(bench.sender.session, [row(99)])
        bench.sender.work()
        bench.broker.problem = "the cable was pulled"
        bench.sender.work()
    assert bench.sender.refused == {}
    bench = SenderBench()
    bench.broker.answers = 0
    bench.drive(1)
    bench.sender.give(1, [row(1), row(2, topic="other")])
    bench.drive(1)
    bench.clock.advance(4 * NS_PER_S)
    assert bench.sender.problem == ""
    bench.drive(2)
    named = "mqtt://a:1: expected an acknowledgement of a message of topic within 4 s, got none"
    assert bench.sender.problem == named
    bench.drive(650)
    assert not bench.sender.connected or len(bench.broker.connections) > 1
    assert bench.broker.connections[0].closed
    bench.drive(50)
    assert (bench.sender.connected, bench.sender.problem) == (True, named), "a new connection acknowledged nothing yet"
    bench.broker.answers = 9
    bench.sender.give(bench.sender.session, [row(1)])
    bench.drive(2)
    assert bench.sender.problem == ""
    bench.broker.answers = 0
    bench.sender.give(bench.sender.session, [row(2, bytes(12_500)), row(3, bytes(12_500), "third")])
    bench.sender.work()
    problems = []  # a message has 4 s, and 5 s for each 12,500 bytes before its end at 20 kbit/s
    for later_ns, answers in ((9 * NS_PER_S, 0), (1, 0), (0, 1), (5 * NS_PER_S - 1, 0), (1, 0), (55 * NS_PER_S, 0)):
        bench.clock.advance(later_ns)
        bench.broker.answers = answers
        bench.sender.work()
        problems.append(bench.sender.problem.removeprefix("mqtt://a:1: expected an acknowledgement of a message of "))
    late = [f"{topic} within 9 s, got none" for topic in ("topic", "third", "third")]
    assert problems == ["", late[0], "", "", *late[1:]]
    bench.clock.advance(5 * NS_PER_S)
    bench.sender.work()
    assert bench.sender.problem == "mqtt://a:1: no acknowledgement of 1 messages within 60 s"


def test_messages_without_a_subscriber_stay_in_the_spool_for_five_minutes() -> None:
    bench, topic = SenderBench(), "data/x"
    rows = [row(n, b"%d" % n, topic) for n in range(1, 6)]
    bench.sender.retain({"state": b"1"})
    bench.drive(5, rows[:2])
    assert bench.done == {1, 2}
    bench.broker.unclaimed = {topic, "state", "data/y"}
    bench.sender.retain({"state": b"2"})
    bench.sender.give(1, [*rows[2:], row(9, topic="data/y")])
    bench.drive(5)
    assert bench.done == {1, 2, 9}, "data/y never had a subscriber"
    assert bench.sender.skipped == bench.sender.refused.keys() == {topic}
    assert bench.sender.refused[topic].startswith("no client has a subscription of this topic any more")
    assert bench.sender.held() == set(), "the writer reads the messages from the spool again"
    for _ in range(3):
        bench.clock.advance(UNCLAIMED_SKIP_NS)
        bench.sender.work()
        bench.sender.give(1, rows[2:])
        bench.drive(2)
        assert bench.done == {1, 2, 9}
    bench.broker.unclaimed = set()
    bench.clock.advance(UNCLAIMED_SKIP_NS)
    bench.sender.work()
    bench.sender.give(1, rows[2:4])
    bench.drive(3)
    assert (bench.done, bench.sender.refused, bench.sender.skipped) == ({1, 2, 3, 4, 9}, {}, frozenset())
    bench.clock.advance(2 * UNCLAIMED_NS)  # a topic with rare messages
    bench.broker.unclaimed = {topic}
    for later_ns, is_done in ((0, False), (UNCLAIMED_NS - NS_PER_S, False), (UNCLAIMED_SKIP_NS, True)):
        bench.clock.advance(later_ns)
        bench.sender.work()
        bench.sender.give(1, rows[4:])
        bench.drive(2)
        assert (5 in bench.done) == is_done
    bench.sender.give(1, [row(6, topic=topic)])
    bench.drive(2)
    assert 6 in bench.done, "the topic has no subscriber any more"


def test_broker_without_retained_messages() -> None:
    bench = SenderBench()
    bench.broker.permits_will = False
    bench.broker.has_retain = False
    bench.sender.retain({"state": b"on"})
    bench.drive(3, [row(1)])
    assert bench.broker.will is None
    assert bench.broker.asked == ["a", "a"], "the second connection has no last will"
    assert (bench.sender.connected, bench.sender.problem, bench.sender.limit) == (True, "", NO_RETAIN)
    assert bench.done == {1}
    bench.broker.permits_will = bench.broker.has_retain = True
    bench.broker.problem = "lost"
    bench.drive(1)
    assert bench.sender.limit == ""
    bench.broker.problem = ""
    bench.drive(3)
    assert bench.broker.will == Will("state", b"gone"), "imud tries the last will at each connection"
    assert bench.sender.limit == ""


def test_large_message_names_the_size_limit_first() -> None:
    bench = SenderBench()
    bench.drive(2, [row(1, bytes(100))])
    bench.broker.closes_on = {"large"}
    rows = [row(number, bytes(5000), "large") for number in (2, 3, 4, 5)]
    problems = []
    for _ in range(12):
        bench.drive(1, rows)
        problems.append(bench.sender.problem)
    advice = "does the broker accept messages of 5000 bytes (largest acknowledged message: 100 bytes)? Otherwise: does"
    named = [problem for problem in problems if "client ID" in problem]
    assert named
    assert all(advice in problem for problem in named)
    assert bench.sender.refused == {
        "large": "the connection was lost, 3 times after a message of this topic; check the access rights of the "
        "gateway, and the size limit of the broker"
    }


def test_flood_of_requests_stays_within_the_budget() -> None:
    """The dearest requests: valid ones above `per_minute`, which get a reply each, and each costs 1 ms."""
    bench = SenderBench()
    cpu_ns = [0]
    budget = WorkBudget(BROKER_LIMITS, lambda: cpu_ns[0])
    bench.sender.budget = budget
    options = CommandOptions(enabled=True, actions=["save"], per_minute=1)
    utc_ns = 1_800_000_000 * NS_PER_S
    channel = CommandChannel(options, Gateway("s", "g", "1"), Mock(), bench.clock.now_ns, lambda: utc_ns)
    replies: list[CommandReply] = []
    channel.answer = replies.append
    channel.may_reply = bench.sender.may_reply
    bench.sender.commands = channel
    bench.drive(1)
    connection = bench.broker.connections[0]
    checked = 0

    def take_one(received: Received) -> None:
        nonlocal checked
        checked += 1
        cpu_ns[0] += 1_000_000
        channel.take(received)

    bench.sender.commands = Mock(wraps=channel)
    bench.sender.commands.take = take_one
    number = 0
    for _ in range(10):  # turns within one second
        for _ in range(100):
            number += 1
            issued_ns = bench.clock.now_ns() + utc_ns
            payload = f'{{"v":1,"id":"{number}","issued_utc_ns":{issued_ns},"action":"save","arguments":{{}}}}'
            connection.received.append(Received("imud/s/g/bow/command", payload.encode(), False, "", None))
        bench.drive(1)
    assert checked <= 10 * 3, "2 ms of CPU time in each turn"
    assert len(replies) <= 20 + 20, "20 replies per second"
    assert channel.refused == 1000 - 1
    assert budget.refused >= 1000 - checked
    assert "sends more than imud processes" in budget.problem(bench.clock.now_ns())
