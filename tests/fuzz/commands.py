"""The command channel over MQTT: for any messages, imud executes only permitted and fresh requests, each one once."""

import asyncio
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Final

import msgspec

from imud.contracts.setting import AppliedSettings
from imud.device.settings_plan import wanted_values
from imud.drivers import DRIVERS
from imud.fleet.broker import Received
from imud.fleet.commands import WAITING_MAX, CommandChannel, CommandReply
from imud.fleet.messages import ANSWER, COMMAND, VERSION, CommandAnswer, Outcome, topic_of
from imud.fleet.settings import CommandOptions
from imud.fleet.streams import Gateway
from imud.model.errors import Rejected
from imud.model.units import NS_PER_S
from tests.fuzz.target import Target
from tests.support.socket_rig import FakeControl

UTC_NS: Final = 1_800_000_000 * NS_PER_S
AGE_NS: Final = NS_PER_S
SETTINGS: Final = CommandOptions(enabled=True, actions=["wake", "set.mode", "bow/save"], per_minute=12)
GATEWAY: Final = Gateway("site", "gw", "0")
TOPIC: Final = topic_of("site", "gw", "bow", COMMAND)
OWN: Final = topic_of("site", "gw", "bow", ANSWER)
SEPARATOR: Final = b"\t"
"""Separator between topic, response topic and payload. Messages are lines, and JSON needs no tab."""
DRIVER: Final = DRIVERS["hipnuc-uart"]
VERBS: Final = DRIVER.verbs


def names() -> Sequence[str]:
    return ["request"]


def make(_name: str) -> Target:
    return Target(run, seeds, words=words)


class _Control(FakeControl):
    """A device that records its requests after the check of their arguments."""

    def __init__(self, device: str, asked: list[tuple[str, str]]) -> None:
        super().__init__(device)
        self._device, self._asked = device, asked

    async def act(self, name: str, arguments: Mapping[str, Any]) -> object:
        self._asked.append((self._device, name))
        if name not in VERBS:
            raise Rejected(f"no action {name}")
        VERBS[name].arguments(arguments)
        return {"done": name}

    async def apply(self, given: Mapping[str, Any] | None, *, save: bool) -> AppliedSettings:
        self._asked.append((self._device, f"set.{next(iter(given or {'': None})).partition('.')[0]}"))
        assert DRIVER.device_settings is not None
        wanted_values(DRIVER.device_settings, given or {})
        return AppliedSettings(saved=save)


@cache
def _loop() -> asyncio.AbstractEventLoop:
    return asyncio.new_event_loop()


def run(data: bytes) -> None:
    """Pass each message, execute the permitted requests, and check all results."""
    asked: list[tuple[str, str]] = []
    replies: list[CommandReply] = []
    channel = CommandChannel(SETTINGS, GATEWAY, lambda name: _Control(name, asked), lambda: AGE_NS, lambda: UTC_NS)
    channel.answer = replies.append
    messages = data.split(b"\n")
    for number, message in enumerate(messages):
        topic, wanted, payload = [*message.split(SEPARATOR, 2), b"", b""][:3]
        texts = [one.decode("utf-8", "replace") for one in (topic, wanted)]
        channel.take(Received(texts[0], payload, number % 16 == 15, texts[1], topic[:3] or None))
    _loop().run_until_complete(_carry_out(channel))
    answers = [msgspec.json.decode(reply.payload, type=CommandAnswer) for reply in replies]
    carried_out = [answer for answer in answers if answer.outcome in (Outcome.DONE, Outcome.FAILED)]
    assert len(asked) <= channel.run == len(carried_out) <= min(SETTINGS.per_minute, WAITING_MAX)
    assert channel.run + channel.refused == len(messages)
    assert len({answer.id for answer in carried_out}) == len(carried_out)
    assert all(SETTINGS.allows(device, action) for device, action in asked)
    for reply, answer in zip(replies, answers, strict=True):
        own, below = topic_of("site", "gw", answer.device, ANSWER), reply.topic.rpartition("/")[0]
        assert own in (reply.topic, below)
        assert not {"+", "#", "\0"} & set(reply.topic)
        assert "defect" not in answer.error, answer.error


async def _carry_out(channel: CommandChannel) -> None:
    for _ in range(2 * WAITING_MAX + 2):
        channel.run_next()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
    channel.close()


def _message(identifier: str, action: str, arguments: object, *, topic: str = TOPIC, wanted: str = "") -> bytes:
    request = {"v": VERSION, "id": identifier, "action": action, "arguments": arguments}
    payload = msgspec.json.encode({**request, "issued_utc_ns": UTC_NS + AGE_NS})
    return SEPARATOR.join((topic.encode(), wanted.encode(), payload))


def seeds() -> list[bytes]:
    every = [_message(f"id-{n}", action, {"rate_hz": 100}) for n, action in enumerate(VERBS)]
    settings = ({"mode": "9-axis"}, {"mode": 9, "save": True}, {"mode.axes": 9}, {"baud": 1}, {"save": 1})
    every += [_message(f"set-{n}", "set", given) for n, given in enumerate(settings)]
    twice = _message("a", "save", {})
    odd = [
        b"", SEPARATOR.join((TOPIC.encode(), b"", b"{}")), SEPARATOR.join((TOPIC.encode(), b"", b"[" * 2000)),
        SEPARATOR.join((TOPIC.encode(), b"", b'"\xff"')),
        _message("b", "save", {"a": [1e300, None, "\U0001f600", {"b": 2**63}]}),
        _message("c", "save", {}, topic="imud/site/other/bow/command"),
        _message("d", "save", {}, topic="imud/site/gw/stern/command"), _message("e", "save", {}, wanted=f"{OWN}/mine"),
        _message("f", "save", {}, wanted="imud/site/other/bow/state"),
        _message("g", "save", {}).replace(str(UTC_NS + AGE_NS).encode(), str(2**70).encode()),
    ]  # fmt: skip
    return [
        *every[:6], b"\n".join(every), twice + b"\n" + twice, *odd, b"\n".join(odd),
        b"\n".join(_message(f"n{n}", "save", {}) for n in range(16)),
    ]  # fmt: skip


def words() -> list[bytes]:
    own = ["v", "id", "action", "arguments", "issued_utc_ns", *VERBS]
    return [TOPIC.encode(), OWN.encode(), SEPARATOR, str(UTC_NS + AGE_NS).encode(), *(f'"{w}"'.encode() for w in own)]
