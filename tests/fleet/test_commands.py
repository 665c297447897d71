"""Command channel: rejected requests and their causes, requests that run once, and a real broker with access rights."""

import asyncio
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest

from imud.contracts.setting import AppliedSettings, SettingDifference
from imud.drivers import DRIVERS
from imud.fleet.broker import Received
from imud.fleet.commands import CommandChannel, CommandReply
from imud.fleet.messages import CommandAnswer, Outcome, answer_topic
from imud.fleet.publisher import MqttPublisher
from imud.fleet.settings import CommandOptions, MqttOptions, check_commands
from imud.fleet.streams import Gateway
from imud.host.clock import HostClock
from imud.host.log import RepeatFilter
from imud.model.errors import BadArgument, CommandError
from imud.model.options import wrong_values
from imud.model.units import NS_PER_S
from tests.fleet.mosquitto import NO_MOSQUITTO, Mosquitto, running_broker
from tests.support.daemon_process import LIMIT_S
from tests.support.event_loops import VirtualClock, in_loop
from tests.support.publisher_context import publisher_context
from tests.support.wired_device import LinkedDevice

ANSWERS_KEPT, WAITING_MAX = 32, 8

UTC_NS = 1_800_000_000 * NS_PER_S
DOCS = Path(__file__).parents[2] / "docs" / "fleet.md"


class FakeDevice:
    def __init__(self) -> None:
        self.settings = self
        self.done: list[tuple[object, ...]] = []
        self.applied = AppliedSettings()
        self.go_on: asyncio.Event | None = None
        self.result: object = {"serial": 7}

    async def act(self, name: str, arguments: Mapping[str, Any]) -> object:
        if name == "turn" and "angle" not in arguments:
            raise BadArgument("angle: expected a number, got nothing")
        if name == "break":
            raise ZeroDivisionError
        if name == "confuse":
            return object()  # a result without JSON
        self.done.append((name, arguments))
        if self.go_on is not None:
            await self.go_on.wait()
        return self.result

    async def apply(self, given: Mapping[str, Any], *, save: bool) -> AppliedSettings:
        self.done.append(("set", given, save))
        return self.applied


class ChannelBench:
    def __init__(self, **settings: object) -> None:
        self.clock = VirtualClock()
        self.clock.advance(5 * NS_PER_S)
        self.device = FakeDevice()
        self.offset_ns = UTC_NS
        self.replies: list[CommandReply] = []
        made = msgspec.convert({"enabled": True, "actions": ["identity", "bow/turn"], **settings}, CommandOptions)
        gateway = Gateway("mill", "gw", "b")
        self.channel = CommandChannel(made, gateway, self._control, self.clock.now_ns, lambda: self.offset_ns)
        self.channel.answer = self.replies.append
        self.clock.advance(NS_PER_S)

    def _control(self, name: str) -> Any:
        if name != "bow":
            raise CommandError(f"{name}: no such device")
        return self.device

    def ask(
        self, number: int = 1, action: str = "identity", *, age_s: float = 0.5, device: str = "bow",
        response_topic: str = "", retain: bool = False, **arguments: object,
    ) -> Outcome | None:  # fmt: skip
        """Send a request. Return the immediate reply, if there is one."""
        issued = self.clock.now_ns() + self.offset_ns - round(age_s * NS_PER_S)
        request = {"v": 1, "id": f"r{number}", "action": action, "arguments": arguments, "issued_utc_ns": issued}
        self.take(msgspec.json.encode(request), device=device, response_topic=response_topic, retain=retain)
        return self.answers()[-1].outcome if self.replies else None

    def take(self, payload: bytes, *, device: str = "bow", response_topic: str = "", retain: bool = False) -> None:
        self.channel.take(Received(f"imud/mill/gw/{device}/command", payload, retain, response_topic, b"c"))

    def answers(self) -> list[CommandAnswer]:
        return [msgspec.json.decode(reply.payload, type=CommandAnswer) for reply in self.replies]

    def run(self, rounds: int = 3) -> None:
        async def loop() -> None:
            for _ in range(rounds):
                self.channel.run_next()
                for _ in range(5):
                    await asyncio.sleep(0)

        asyncio.run(loop())


def test_the_reply_of_a_request_contains_its_correlation() -> None:
    bench = ChannelBench()
    assert bench.ask(1, "turn", angle=3, response_topic="imud/mill/gw/bow/answer/me") is None
    assert bench.device.done == [], "the sender's thread runs no command"
    bench.run()
    assert bench.device.done == [("turn", {"angle": 3})]
    (reply,) = bench.replies
    assert (reply.topic, reply.correlation) == ("imud/mill/gw/bow/answer/me", b"c")
    (answer,) = bench.answers()
    assert (answer.id, answer.outcome, answer.result) == ("r1", Outcome.DONE, {"serial": 7})
    assert (bench.channel.run, bench.channel.refused) == (1, 0)
    bench.ask(2)
    bench.run()
    assert bench.replies[1].topic == "imud/mill/gw/bow/answer", "the default is the reply topic of the device"


def test_commands_that_are_not_allowed_are_denied() -> None:
    bench = ChannelBench()
    assert bench.ask(1, "factory_reset") is Outcome.DENIED
    assert bench.ask(2, "turn", device="mast", angle=3) is Outcome.DENIED
    bench.ask(3, "bow/turn")
    assert ChannelBench(actions=[]).ask() is Outcome.DENIED
    bench.run()
    assert (bench.device.done, bench.channel.refused, len(bench.replies)) == ([], 3, 2)
    (wrong,) = wrong_values(CommandOptions, {"actions": ["a b"]})
    assert "expected names of commands, set.SETTING, or DEVICE/COMMAND" in str(wrong)
    assert wrong_values(CommandOptions, {"actions": ["a", "bow/a", "set", "set.mode", "bow/set.mode"]}) == []
    (problem,) = check_commands(MqttOptions(commands=CommandOptions(actions=["set", "bow/set", "save"])), {}).values()
    assert problem.startswith('expected a command that imud knows, got "save"')
    drivers = {name: DRIVERS[name] for name in ("hipnuc-uart", "hipnuc-canopen", "hipnuc-j1939", "imu61x-uart")}
    for action, step in (
        ("bow/output", "use bow/set.output"), ("rate", "use set.output_rate_hz"), ("settings", "remove it"),
        ("direction", "use set.incli_x_reversed, set.incli_y_reversed, set.x_reversed, set.y_reversed"),
    ):  # fmt: skip
        actions = ["save", "set.mode", "bow/set.baud", "reset", action]
        problems = check_commands(MqttOptions(commands=CommandOptions(actions=actions)), drivers)
        words = f'expected a command, got "{action}", which is a setting now; {step}'
        assert problems == {("commands", "actions"): words}
    (problem,) = check_commands(MqttOptions(commands=CommandOptions(actions=["set.mod"])), drivers).values()
    assert problem.startswith('expected a setting after set. that imud knows, got "mod"; did you mean mode?')
    for entry in ("set.", "set.output.hi91", "get.mode"):
        assert wrong_values(CommandOptions, {"actions": [entry]})


def test_no_request_of_the_broker_starts_a_firmware_update() -> None:
    """The check of the configuration rejects the command, and a request for it does not reach the update."""
    action, drivers = "firmware", {name: DRIVERS[name] for name in ("hipnuc-uart", "hipnuc-canopen")}
    options = MqttOptions(commands=CommandOptions(actions=[action]))
    (problem,) = check_commands(options, drivers).values()
    assert problem.startswith(f'expected a command that imud knows, got "{action}"')
    bench, linked = ChannelBench(actions=[action]), LinkedDevice()
    bench.device = linked.device  # type: ignore[assignment]  # a device with its driver
    assert bench.ask(1, action, file="new.hex", address=0, crc32=0) is None
    bench.run()
    (answer,) = bench.answers()
    assert (answer.outcome, linked.link.written) == (Outcome.FAILED, [])
    assert answer.error.startswith(f"bow: unknown command '{action}'")


@pytest.mark.parametrize(
    ("actions", "arguments", "allowed"),
    [
        (["set"], {"mode": "9-axis", "output.hi91": 200, "save": True}, True), (["set"], {"save": True}, True),
        (["bow/set"], {"mode": "9-axis"}, True), (["mast/set", "save"], {"mode": "9-axis"}, False),
        (["set.mode"], {"mode": "9-axis", "save": True}, True),
        (["set.mode", "bow/set.output"], {"mode": "9-axis", "output.hi91": 200}, True),
        (["set.mode"], {"mode": "9-axis", "output.hi91": 200}, False),
        (["set.mode", "mast/set.output"], {"output": {"hi91": 200}}, False), (["set.mode"], {"save": True}, False),
        (["set.mode"], {}, False),
    ],
)  # fmt: skip
def test_settings_are_set_if_each_is_allowed(actions: list[str], arguments: dict[str, Any], allowed: bool) -> None:
    bench = ChannelBench(actions=actions)
    assert (bench.ask(1, "set", **arguments) is None) is allowed
    bench.run()
    (answer,) = bench.answers()
    assert answer.outcome is (Outcome.DONE if allowed else Outcome.DENIED)
    settings = {name: value for name, value in arguments.items() if name != "save"}
    assert bench.device.done == ([("set", settings, arguments.get("save", False))] if allowed else [])


def test_the_reply_of_set_reports_what_the_device_lacks() -> None:
    bench = ChannelBench(actions=["set"])
    for applied, failure in (
        (AppliedSettings(saved=True), ""),
        (AppliedSettings(problem="mode: the device rejected it"), "mode: the device rejected it"),
        (AppliedSettings(left_out={"mounting": "needs a save"}), "mounting needs a save"),
        (AppliedSettings(differences={"mode": SettingDifference(9, 6)}), "mode: expected 9, got 6"),
    ):
        bench.device.applied = applied
        bench.ask(len(bench.replies), "set", mode=9)
        bench.run()
        answer = bench.answers()[-1]
        assert (answer.outcome, answer.error) == (Outcome.FAILED if failure else Outcome.DONE, failure)
        assert msgspec.convert(answer.result, AppliedSettings) == applied
    wrong: list[tuple[dict[str, Any], str]] = [
        ({}, "expected at least one setting by name"), ({"save": 1}, "save: expected true or false, got 1"),
    ]  # fmt: skip
    for arguments, error in wrong:
        bench.ask(len(bench.replies), "set", **arguments)
        bench.run()
        assert (bench.answers()[-1].outcome, error in bench.answers()[-1].error) == (Outcome.FAILED, True)


@pytest.mark.parametrize(
    ("age_s", "taken"), [(30.0, False), (30.1, False), (-30.0, True), (-30.1, False), (1.0, True), (1.1, False)]
)
def test_old_and_future_requests_are_rejected(age_s: float, taken: bool) -> None:
    bench = ChannelBench()  # the output started 1 s ago, so an older request was not for it
    assert (bench.ask(age_s=age_s) is None) is taken
    bench = ChannelBench()
    bench.clock.advance(100 * NS_PER_S)
    assert (bench.ask(age_s=age_s) is None) is (abs(age_s) <= 30)


def test_a_request_runs_once_and_not_when_it_is_too_old() -> None:
    bench = ChannelBench()
    bench.ask(1)
    bench.clock.advance(31 * NS_PER_S)
    bench.run()
    assert [one.outcome for one in bench.answers()] == [Outcome.STALE]
    assert bench.device.done == []
    bench.offset_ns = 0
    assert bench.ask(2) is Outcome.STALE, "imud runs no request without a set clock"
    bench = ChannelBench(per_minute=600)
    bench.ask(1, age_s=-29.0)
    bench.run()
    issued_ahead_ns = bench.clock.now_ns() + bench.offset_ns + 29 * NS_PER_S
    for _ in range(59):
        bench.clock.advance(NS_PER_S)
        age_s = (bench.clock.now_ns() + bench.offset_ns - issued_ahead_ns) / NS_PER_S
        assert bench.ask(1, "turn", age_s=age_s, angle=3) in (Outcome.DUPLICATE, Outcome.STALE)
        bench.ask(1, age_s=age_s)
    bench.run()
    assert len(bench.device.done) == 1


def test_a_repeated_request_receives_the_stored_reply() -> None:
    bench = ChannelBench()
    bench.ask(1, "turn", angle=3)
    assert bench.ask(1, "turn", angle=3) is Outcome.DUPLICATE, "the first request waits for its reply"
    bench.run()
    bench.replies.clear()
    bench.ask(1, "turn", angle=3, response_topic="imud/mill/gw/bow/answer/other")
    (reply,) = bench.replies
    assert (reply.topic, reply.correlation) == ("imud/mill/gw/bow/answer/other", b"c")
    assert (bench.answers()[0].outcome, bench.answers()[0].result) == (Outcome.DONE, {"serial": 7})
    bench.ask(1, "turn", angle=4)
    assert bench.answers()[-1].outcome is Outcome.DUPLICATE, "a different request with the same id"
    bench.run()
    assert (bench.device.done, (bench.channel.run, bench.channel.refused)) == ([("turn", {"angle": 3})], (1, 2))
    for _ in range(2):  # the second request receives the stored failure
        bench.replies.clear()
        bench.ask(2, "turn")
        bench.run()
        assert [(one.outcome, one.error.split(":")[0]) for one in bench.answers()] == [(Outcome.FAILED, "angle")]


def test_the_number_of_stored_replies_is_limited() -> None:
    bench = ChannelBench(per_minute=600)
    for number in range(ANSWERS_KEPT + 1):
        bench.ask(number)
        bench.run()
    assert bench.ask(0) is Outcome.DUPLICATE
    assert bench.ask(1) is Outcome.DONE
    assert len(bench.device.done) == ANSWERS_KEPT + 1
    overhead_bytes = len(bench.replies[0].payload) - len(b'{"serial":7}') + len(b'""')
    for size, outcome in ((65_536, Outcome.DONE), (65_537, Outcome.DUPLICATE)):
        bench = ChannelBench()
        bench.device.result = "x" * (size - overhead_bytes)
        bench.ask(0)
        bench.run()
        assert len(bench.replies[0].payload) == size
        assert bench.ask(0) is outcome


def test_requests_above_the_rate_or_the_queue_are_rejected_as_busy() -> None:
    bench = ChannelBench(per_minute=5)
    assert [bench.ask(number) for number in range(5)] == [None] * 5
    assert bench.ask(5) is Outcome.BUSY
    bench.run(rounds=10)
    bench.clock.advance(60 * NS_PER_S)
    bench.replies.clear()
    assert bench.ask(6) is None
    bench = ChannelBench(per_minute=600)
    assert [bench.ask(number) for number in range(WAITING_MAX)] == [None] * WAITING_MAX
    assert bench.ask(99) is Outcome.BUSY
    bench.run(rounds=WAITING_MAX + 1)
    assert len(bench.device.done) == WAITING_MAX


VALID = b'{"v": 1, "id": "a", "action": "identity", "issued_utc_ns": 1}'


@pytest.mark.parametrize(
    "payload",
    [
        b"", b"{}", b"[]", b"\xff", b'{"v": 1}', b"[" * 3000, VALID.ljust(4097),
        b'{"v": 2, "id": "a", "action": "identity", "issued_utc_ns": 1}',
        b'{"v": 1, "id": "a/b", "action": "identity", "issued_utc_ns": 1}',
        b'{"v": 1, "id": "a", "action": "identity", "issued_utc_ns": 1, "more": 1}',
        b'{"v": 1, "id": "a", "action": "", "issued_utc_ns": 1}',
    ],
)  # fmt: skip
def test_invalid_requests_are_counted_without_a_reply(payload: bytes) -> None:
    bench = ChannelBench()
    bench.take(payload)
    assert (bench.channel.refused, bench.replies) == (1, [])
    bench.take(VALID.ljust(4096))
    assert bench.answers()[-1].outcome is Outcome.STALE


def test_retained_requests_and_foreign_reply_topics_are_ignored() -> None:
    bench = ChannelBench()
    bench.ask(1, retain=True)
    for topic in ("imud/mill/gw/bow/samples", "imud/mill/gw/state", "imud/mill/gw/mast/answer", "a/b",
                  "imud/mill/gw/bow/answer/a/b", "imud/mill/gw/bow/answer/#", "imud/mill/gw/bow/answer/"):  # fmt: skip
        bench.ask(2, response_topic=topic)
        assert answer_topic("mill", "gw", "bow", topic) is None
    for topic in ("imud/mill/other/bow/command", "imud/mill/gw/bow/status", "imud/mill/gw"):
        bench.channel.take(Received(topic, VALID, False, "", b""))
    bench.run()
    assert (bench.channel.refused, bench.replies, bench.device.done) == (11, [], [])


def test_errors_and_internal_errors_have_a_reply() -> None:
    bench = ChannelBench(actions=["identity", "turn", "break", "confuse"])
    bench.ask(1, "turn")
    bench.ask(2, "identity", device="mast")
    bench.ask(3, "break")
    bench.ask(4, "confuse")
    bench.run(rounds=6)
    assert [(one.outcome, one.error) for one in bench.answers()] == [
        (Outcome.FAILED, "angle: expected a number, got nothing"),
        (Outcome.FAILED, "mast: no such device"),
        *[(Outcome.FAILED, "internal error; see the traceback in the log of imud")] * 2,
    ]


def test_every_request_is_in_the_log(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(caplog.handler, "filters", [RepeatFilter()])  # as in the log of the daemon
    bench = ChannelBench(actions=["identity", "turn"])
    for number in range(4):
        bench.ask(number)
        bench.ask(100 + number, "turn")
        bench.ask(200 + number, "factory_reset")
        bench.run(rounds=2)
    asked = {f"request r{number}" for number in (*range(4), *range(100, 104), *range(200, 204))}
    assert asked <= set(re.findall(r"request r\d+", caplog.text))


@in_loop
async def test_one_request_runs_at_a_time_and_close_stops_it() -> None:
    bench = ChannelBench()
    bench.device.go_on = asyncio.Event()
    bench.ask(1)
    bench.ask(2)
    for _ in range(5):
        bench.channel.run_next()
        await asyncio.sleep(0)
    assert len(bench.device.done) == 1
    bench.channel.close()
    bench.channel.close()
    bench.device.go_on.set()
    for _ in range(5):
        await asyncio.sleep(0)
    bench.channel.run_next()
    await asyncio.sleep(0)
    assert (len(bench.device.done), bench.replies) == (1, [])


# --- broker with the access rights of docs/fleet.md -------------------------------------------------------------------

USERS = ("gw-17", "gw-18", "collector", "operator")


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    if NO_MOSQUITTO:
        pytest.skip(NO_MOSQUITTO)
    found = re.search(r"```acl\n(.*?)```", DOCS.read_text(), re.DOTALL)
    assert found is not None
    rights, passwords = tmp_path / "rights", tmp_path / "passwords"
    rights.write_text(found.group(1))
    passwords.write_text("".join(f"{user}:secret\n" for user in USERS))
    program = shutil.which("mosquitto_passwd")
    if program is None:
        pytest.skip("mosquitto_passwd is not installed (make mqtt-deps)")
    subprocess.run([program, "-U", passwords], check=True, capture_output=True)  # encrypts the passwords
    lines = ("allow_anonymous false", f"password_file {passwords}", f"acl_file {rights}")
    with running_broker(tmp_path / "broker", *lines) as made:
        yield made


class Operator:
    def __init__(self, port: int, user: str, *, v5: bool = True) -> None:
        from paho.mqtt.client import Client, MQTTv5, MQTTv311
        from paho.mqtt.enums import CallbackAPIVersion

        self.got: list[Any] = []
        self.changed = threading.Condition()
        self.v5 = v5
        self._ready = threading.Event()
        self.client = Client(CallbackAPIVersion.VERSION2, "", protocol=MQTTv5 if v5 else MQTTv311)
        self.client.username_pw_set(user, "secret")
        self.client.on_connect = lambda client, *_: client.subscribe("imud/#", qos=1)
        self.client.on_subscribe = lambda *_: self._ready.set()
        self.client.on_message = self._on_message
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()
        assert self._ready.wait(LIMIT_S)

    def _on_message(self, _client: object, _data: object, message: Any) -> None:
        with self.changed:
            self.got.append(message)
            self.changed.notify_all()

    def ask(self, device: str, number: str, action: str, response_topic: str = "", qos: int = 1) -> None:
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        properties = None
        if self.v5:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]  # the library has no types
            properties.CorrelationData = number.encode()
            properties.MessageExpiryInterval = 30
            if response_topic:
                properties.ResponseTopic = response_topic
        issued_ns = HostClock().now_ns() + HostClock().utc_offset_ns()
        request = {"v": 1, "id": number, "action": action, "issued_utc_ns": issued_ns}
        topic = f"imud/mill/gw-17/{device}/command"
        self.client.publish(topic, msgspec.json.encode(request), qos, properties=properties)

    def answer(self, number: str) -> tuple[Any, CommandAnswer]:
        def found() -> list[tuple[Any, CommandAnswer]]:
            mine = [one for one in self.got if "/answer" in one.topic]
            answers = [(one, msgspec.json.decode(one.payload, type=CommandAnswer)) for one in mine]
            return [one for one in answers if one[1].id == number]

        with self.changed:
            assert self.changed.wait_for(lambda: bool(found()), LIMIT_S), [one.topic for one in self.got]
            return found()[0]

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


class Loop:
    def __init__(self, folder: Path, port: int, device: FakeDevice, version: str) -> None:
        host, password = HostClock(), folder / "password"
        password.write_text("secret\n")
        settings = msgspec.convert(
            {
                "brokers": [f"mqtt://127.0.0.1:{port}"], "site": "mill", "gateway": "gw-17", "version": version,
                "user": "gw-17", "password_file": str(password), "spool_directory": str(folder / "spool"),
                "commands": {"enabled": True, "actions": ["identity"]},
            },
            MqttOptions,
        )  # fmt: skip
        context = publisher_context(
            # the members that the channel uses
            list, 7, host.now_ns, utc_offset_ns=host.utc_offset_ns, control=lambda _name: device  # type: ignore[arg-type,return-value]
        )  # fmt: skip
        self.output = MqttPublisher(settings, context)
        self._ended = threading.Event()
        self.up = threading.Event()
        self._host = host
        self._thread = threading.Thread(target=lambda: asyncio.run(self._main()))
        self._thread.start()
        assert self.up.wait(LIMIT_S)

    async def _main(self) -> None:
        self.output.start()
        while not self._ended.is_set():
            self.output.tick(self._host.now_ns())
            if self.output.status().broker:
                self.up.set()
            await asyncio.sleep(0.02)
        self.output.close()

    def close(self) -> None:
        self._ended.set()
        self._thread.join(LIMIT_S)


@pytest.mark.live
@pytest.mark.parametrize("version", ["5", "3.1.1"])
def test_a_broker_accepts_requests_of_the_operator_only(tmp_path: Path, broker: Mosquitto, version: str) -> None:
    device = FakeDevice()
    loop = Loop(tmp_path, broker.port, device, version)
    operator, collector = Operator(broker.port, "operator", v5=version == "5"), Operator(broker.port, "collector")
    others = [Operator(broker.port, user) for user in ("collector", "gw-18")]
    try:
        for other in others:  # the broker accepts the messages but does not deliver them
            other.ask("bow", f"of-{other is others[0]}", "identity", qos=0)  # mosquitto 2.0.11 may close the connection
        operator.ask("bow", "first", "identity", "imud/mill/gw-17/bow/answer/desk")
        message, answer = operator.answer("first")
        assert (answer.outcome, answer.result) == (Outcome.DONE, {"serial": 7})
        if version == "5":
            assert message.topic == "imud/mill/gw-17/bow/answer/desk"
            assert message.properties.CorrelationData == b"first"
        else:
            assert message.topic == "imud/mill/gw-17/bow/answer"
        operator.ask("bow", "second", "restart")
        assert operator.answer("second")[1].outcome is Outcome.DENIED
        operator.ask("bow", "first", "identity")
        operator.ask("bow", "third", "identity")
        operator.answer("third")
        assert len(device.done) == 2, "two requests of the operator, each once, and no request of others"
        assert not any("/answer" in one.topic for one in others[1].got), "gateways do not read each other"
        collector.answer("third")  # the collector may read all topics
        assert sum("Denied PUBLISH" in line for line in broker.log) == 2
        status = loop.output.status()
        assert (status.commands, status.commands_refused) == (2, 1)
        again = [one for one in operator.got if b'"first"' in one.payload and "/answer" in one.topic]
        assert len(again) == 2, "a repeated request receives its reply again"
    finally:
        loop.close()
        for one in (operator, collector, *others):
            one.close()
