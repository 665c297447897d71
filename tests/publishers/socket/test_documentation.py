"""Each example in docs/socket.md runs against the server."""

import json
import os
import re
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

from imud.contracts import status as states
from imud.contracts.setting import SettingsState, SettingsStatus, StepOutcome
from imud.formats import kernel
from imud.formats.jsonrpc import DEFAULT_PATH, LINE_MAX_BYTES, Code
from imud.model.event import Event, EventKind
from imud.publishers.socket.methods import METHODS, RATE_MAX_HZ, RATE_MIN_HZ
from imud.publishers.socket.outbox import Limits
from imud.publishers.socket.server import SocketOptions, SocketServer
from tests.support.files import ROOT
from tests.support.socket_rig import LIMIT_S, NOW_NS, Peer, batch, daemon, in_server, until

DOCUMENT = (ROOT / "docs" / "socket.md").read_text()
ANYTHING = "…"


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", DOCUMENT, re.MULTILINE | re.DOTALL)


def assert_like(found: Any, shown: Any) -> None:
    if shown == ANYTHING:
        return
    if isinstance(shown, dict):
        assert isinstance(found, dict)
        names = shown.keys() - {ANYTHING}
        assert found.keys() >= names if ANYTHING in shown else found.keys() == names
        for name in names:
            assert_like(found[name], shown[name])
    elif isinstance(shown, list):
        some = shown[:-1] if ANYTHING in shown else shown
        assert len(found) >= len(some) if ANYTHING in shown else len(found) == len(some)
        for item, expected in zip(found, some, strict=False):
            assert_like(item, expected)
    else:
        assert found == shown


def happen(server: SocketServer, shown: dict[str, Any], published: list[int]) -> None:
    if shown.get("method") == "sample":
        published.append(shown["params"]["seq"])
        server.publish(batch("imu0", published[-1]))
    if shown.get("method") == "event":
        server.event(Event(NOW_NS, "imu0", EventKind.DOWN, "the adapter was pulled out", {"errno": 5}))


@patch.object(kernel, "present", kernel.Kernel(ModuleType("kernel")))  # the tests also run without a C compiler
@in_server()
async def test_examples(server: SocketServer) -> None:
    lines = [line for block in blocks("json") for line in block.splitlines()]
    published: list[int] = []
    peer = await Peer.connect(server)
    for line in lines:
        arrow, text = line[0], line[2:]
        if arrow == "→":
            if '"poll"' in text:
                server.publish(batch("imu0", 1))
            await peer.send(text.encode() + b"\n")
        else:
            assert arrow == "←"
            happen(server, json.loads(text), published)
            assert_like(await peer.message(), json.loads(text))
    asked = {json.loads(line[2:])["method"] for line in lines if line.startswith("→ {")}
    assert (asked, published) == (set(METHODS), [2])


def test_python_example(tmp_path: Path, capsys: Any) -> None:
    (code,) = blocks("python")
    with daemon(tmp_path) as served:
        published = served.start(publish_on_watch)  # the example waits for a sample
        exec(compile(code.replace(DEFAULT_PATH, served.path), "docs/socket.md", "exec"), {})
        published.result(LIMIT_S)
    assert capsys.readouterr().out.splitlines()[1] == "80000001000000 (0.125, -0.5, 9.75)"


async def publish_on_watch(server: SocketServer) -> None:
    await until(lambda: any(client.encoding for client in server.hub.clients()))
    server.publish(batch("imu0"))


def test_numbers_and_codes_of_the_text() -> None:
    settings = SocketOptions()
    limits = Limits(settings.queue_samples, settings.queue_bytes)
    for words in (
        f"at most {LINE_MAX_BYTES:,} bytes",
        f"at most {limits.samples:,} samples and {limits.sample_bytes >> 20} MiB",
        f"more than {limits.replies:,} or {limits.reply_bytes >> 20} MiB",
        f"{RATE_MIN_HZ} … {RATE_MAX_HZ}",
        *(f"| {code.value} |" for code in Code if code is not Code.INTERNAL),
        *(f"`{name}`" for name in (settings.group, settings.control_group, DEFAULT_PATH)),
        *(f"`{word}`" for word in (*SettingsState, *StepOutcome, *EventKind)),
    ):
        assert words in DOCUMENT, words
    assert os.path.isabs(settings.path)


def test_every_member_of_status_is_explained() -> None:
    section = DOCUMENT.partition("\n## Status\n")[2].partition("\n## ")[0]
    rows = [row.split(" | ")[0] for row in section.splitlines() if row.startswith("| `")]
    known = {str(state) for state in states.DeviceState}
    first = {name for cell in rows for name in re.findall(r"`(\w+)`", cell)}
    assert known <= first
    first -= known
    in_devices = {"name", "device_id", "driver", "link", "state", "problem", "identity", "rate_hz"}
    assert first | in_devices == set(states.DeviceStatus.__struct_encode_fields__)
    named = set(re.findall(r"`(\w+)`", section))
    names = ("ClockStatus", "KernelCounters", "PollingStatus", "SerialLineCounters", "LinesStatus", "UtcStatus")
    for part in (*(getattr(states, name) for name in names), SettingsStatus):
        assert set(part.__struct_encode_fields__) <= named, part.__name__
