"""An output that fails is closed and started again; devices and other outputs continue."""

import subprocess
import sys
from collections.abc import Callable
from typing import Any, cast
from unittest.mock import Mock, call

import msgspec
import pytest

from imud.contracts.publisher import Batch, Publisher, PublisherType
from imud.host.scope import ThreadScopes
from imud.model.errors import ServerError
from imud.model.event import Event, EventKind
from imud.model.options import Options
from imud.model.units import NS_PER_S
from imud.publishers import PUBLISHERS
from imud.publishers import outputs as module
from imud.publishers.outputs import Outputs
from tests.support.event_loops import VirtualClock
from tests.support.publisher_context import publisher_context

DEFAULTS: dict[str, dict[str, Any]] = {
    "socket": {
        "enabled": True, "path": "/run/imud/imud.sock", "group": "imud", "control_group": "imud-control",
        "clients_max": 256, "clients_per_user": 128, "memory_mb": 64, "queue_samples": 4096, "queue_bytes": 4_194_304,
        "history": None,
    },
    "shm": {
        "enabled": True, "directory": "/run/imud/shm", "slots": 4096, "latency_ms": 5, "group": "imud", "mode": 0o640,
    },
    "metrics": {"enabled": True, "address": "127.0.0.1", "port": 9321, "motion": True},
    "recorder": {
        "enabled": False, "directory": "/var/lib/imud/recordings", "devices": None, "keep_gb": 10, "file_mb": 100,
        "file_minutes": 60,
        "flight": {
            "enabled": False, "minutes": 5, "after_s": 30, "memory_mb": 64, "directory": "", "acceleration_m_s2": None,
            "device_lost": True, "line": None, "per_hour": 6,
        },
    },
    "nmea0183": {
        "enabled": False, "device": None, "sentences": {"HDT": 10, "HDG": 10, "ROT": 10, "XDR": 2}, "talker": "",
        "tcp_address": "127.0.0.1", "tcp_port": 10110, "udp": [], "serial_port": None, "serial_baud": 38400,
    },
    "rules": {"enabled": False, "rules": {}, "commands": {"running": 4, "per_hour": 60, "time_s": 30}},
    "ros2": {"enabled": False, "domain_id": 0, "node": "imud", "address": None, "devices": {"*": {"rate_hz": None}}},
    "nmea2000": {
        "enabled": False, "interface": "can0", "device": None,
        "messages": {"heading": 10, "rate_of_turn": 10, "attitude": 1}, "address": 128, "instance": 0,
        "share_interface": False,
    },
    "signalk": {
        "enabled": False, "device": None, "url": "http://127.0.0.1:3000", "ca_file": None, "rate_hz": 10,
    },
    "influx": {
        "enabled": False, "to": {}, "devices": None, "rate_hz": 10, "site": "", "gateway": "", "batch_s": 1,
        "ledger_s": 10, "queue_mb": 16,
    },
    "mqtt": {
        "enabled": False, "brokers": ["mqtt://127.0.0.1:1883"], "version": "5", "site": "default", "gateway": "",
        "user": "", "password_file": None, "ca_file": None, "cert_file": None, "key_file": None, "keep_alive_s": 30,
        "retry_max_s": 60, "messages_per_s": None, "newest_first": False, "spool_directory": "/var/lib/imud/mqtt",
        "spool_mb": 256, "spool_hours": 168, "status_s": 60, "home_assistant": False,
        "commands": {"enabled": False, "actions": [], "max_age_s": 30, "per_minute": 30},
        "devices": {
            "*": {
                "rate_hz": 1, "values": ["mean", "min", "max", "rms"], "whole": "none", "batch_s": 1, "events": True,
                "status": True, "settings": True,
            },
        },
    },
}  # fmt: skip
"""Defaults of docs/configuration.md."""


def test_rows_and_defaults() -> None:
    rows = {name: PUBLISHERS[name] for name in PUBLISHERS}
    assert {name: msgspec.to_builtins(row.settings()) for name, row in rows.items()} == DEFAULTS
    assert [name for name, row in rows.items() if row.required] == ["socket", "shm"]
    assert all(name == row.name for name, row in rows.items())


def test_an_output_that_is_off_imports_nothing() -> None:
    program = (
        "import sys\nfrom imud.publishers import PUBLISHERS\nfor name in PUBLISHERS: PUBLISHERS[name]\n"
        "print(*sys.modules)"
    )
    loaded = set(subprocess.check_output([sys.executable, "-c", program], text=True).split())
    assert not loaded & {
        "imud.publishers.influx.publisher",
        "imud.publishers.influx.destinations",
        "imud.formats.influx",
    }


class Switch(Options, frozen=True):
    """Options of an output of the test."""

    enabled: bool = True


class FakeOutput:
    """An output that notes its calls, and raises an exception in the methods of `failing`."""

    def __init__(self, rig: "Rig", name: str) -> None:
        self._rig, self._name = rig, name
        self.publish: Callable[[Batch], None] = lambda batch: self._do("publish", batch)

    def __getattr__(self, method: str) -> Any:
        return lambda *arguments: self._do(method, *arguments)

    def _do(self, method: str, *arguments: object) -> None:
        self._rig.did.append((self._name, method, *arguments))
        if error := self._rig.failing.get((self._name, method)):
            raise error


class Rig:
    """Outputs of these names and modules. The output `must` is required, the others are optional."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, modules: dict[str, str]) -> None:
        self.did: list[tuple[object, ...]] = []
        self.failing: dict[tuple[str, str], BaseException] = {}
        self.clock = VirtualClock()
        rows = {name: self._row(name, at) for name, at in modules.items()}
        monkeypatch.setattr(module, "PUBLISHERS", rows)
        self.context = publisher_context(now_ns=self.clock.now_ns)
        self.outputs = Outputs(self.context, {}, ThreadScopes())
        self.options = dict.fromkeys(rows, Switch())

    def _row(self, name: str, module_name: str) -> PublisherType:
        def make(_settings: object, _context: object) -> Publisher:
            return cast("Publisher", type(name, (FakeOutput,), {"__module__": module_name})(self, name))

        return PublisherType(name, Switch, make, required=name == "must")

    def start(self, *extra: tuple[str, int]) -> None:
        self.outputs.start(self.options)
        for device in (("bow", 0), *extra):
            self.outputs.add_device(*device)
        self.did.clear()

    def run(self, seconds: float) -> None:
        self.clock.advance(round(seconds * NS_PER_S))
        self.outputs.tick(self.clock.now_ns())

    def done(self, *methods: str) -> list[tuple[object, ...]]:
        """Return output and method of all calls of `methods` since the last call."""
        found, self.did = [call for call in self.did if call[1] in methods], []
        return [call[:2] for call in found]


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    return Rig(monkeypatch, dict.fromkeys(("one", "two", "must"), "a"))


BATCH = cast("Batch", object())
EVENT = Event(0, "bow", EventKind.UP, "found")
CALLS: dict[str, Callable[[Rig], None]] = {
    "publish": lambda rig: rig.outputs.publish(BATCH), "event": lambda rig: rig.outputs.send_event(EVENT),
    "tick": lambda rig: rig.run(0), "add_device": lambda rig: rig.outputs.add_device("mast", 1),
    "remove_device": lambda rig: rig.outputs.remove_device("bow"),
}  # fmt: skip


@pytest.mark.parametrize("method", CALLS)
@pytest.mark.parametrize("name", ["one", "must"])
def test_an_exception_restarts_its_output(rig: Rig, caplog: pytest.LogCaptureFixture, name: str, method: str) -> None:
    rig.start()
    rig.failing[(name, method)] = OverflowError("too large")
    CALLS[method](rig)
    others = [other for other in rig.options if other != name]
    events = [call for call in rig.did if call[1] == "event" and call[2] is not EVENT]
    assert [call[0] for call in events] == others
    assert cast("Event", events[0][2]).message.startswith(f"{name}: internal error OverflowError: too large")
    assert set(rig.done(method, "close")) >= {*((other, method) for other in others), (name, method), (name, "close")}
    assert "Traceback" in caplog.text
    rig.failing.clear()
    rig.outputs.publish(BATCH)
    assert rig.done("publish") == [(other, "publish") for other in others]
    rig.run(0.9)
    assert rig.done("start") == []
    rig.run(0.1)
    devices = 2 if method == "add_device" else 0 if method == "remove_device" else 1
    assert rig.done("add_device", "start") == [(name, "add_device")] * devices + [(name, "start")]
    rig.outputs.publish(BATCH)
    assert len(rig.done("publish")) == 3


def test_the_pause_doubles_and_is_short_again_after_a_long_run(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    rig.start()
    rig.failing[("one", "publish")] = ValueError("always")
    for pause_s in (1, 2, 4, 8, 16, 32, 60, 60):
        rig.outputs.publish(BATCH)
        assert rig.outputs.summary() == "two, must (not yet: one)"
        rig.run(pause_s - 0.1)
        assert rig.done("start") == []
        rig.run(0.1)
        assert rig.done("start") == [("one", "start")]
    assert caplog.text.count("ERROR") == 8, "each error of a running output"
    for forget in (lambda: rig.run(600.1), lambda: rig.outputs.change_to("one", Switch())):
        forget()
        rig.outputs.publish(BATCH)
        rig.did.clear()
        rig.run(1)
        assert rig.done("start") == [("one", "start")]


@pytest.mark.parametrize("error", [ServerError("port in use"), OSError(97, "no IPv6")])
def test_an_output_that_cannot_start_tries_again(rig: Rig, caplog: pytest.LogCaptureFixture, error: Exception) -> None:
    caplog.set_level("INFO")
    rig.failing[("two", "start")] = error
    rig.start()
    assert (rig.outputs.summary(), list(rig.context.outputs.problems())) == ("one, must (not yet: two)", ["two"])
    assert {state.name: state.running for state in rig.context.outputs.states()} == {
        "must": True,
        "one": True,
        "two": False,
    }
    assert str(error) in rig.context.outputs.problems()["two"]
    assert ("Traceback" in caplog.text) == isinstance(error, OSError)
    caplog.clear()
    rig.failing |= {("two", "start"): KeyError("mode"), ("two", "close"): KeyError("thread")}
    rig.run(1)
    new = "two: internal error KeyError: 'mode'; imud continues without this output and tries again"
    assert caplog.messages == ["two: the end failed", new], "another reason, and an error of the clean-up"
    rig.failing.clear()
    rig.run(2)
    assert rig.done("start", "close") == [("two", "start"), ("two", "close"), ("two", "start")]
    assert (rig.outputs.summary(), rig.context.outputs.problems()) == ("one, must, two", {})
    assert [text for text in caplog.messages if "started" in text] == ["two: started"]


def test_a_required_output_that_cannot_start_stops_imud_only_at_the_start(rig: Rig) -> None:
    rig.failing[("must", "start")] = ServerError("no permission")
    with pytest.raises(ServerError, match="no permission"):
        rig.outputs.start(rig.options)
    rig.failing.clear()
    rig.outputs.close()
    rig.start()
    rig.failing |= {("must", "publish"): ValueError(), ("must", "start"): ServerError("gone")}
    rig.outputs.publish(BATCH)
    rig.run(1)
    rig.run(2)
    assert rig.done("start") == [("must", "start")] * 2


def test_changed_options_that_fail_keep_the_old_options(rig: Rig) -> None:
    rig.start()
    rig.failing[("must", "start")] = KeyError("mode")
    problem = rig.outputs.change_to("must", Switch())
    assert problem == "must keeps its old options: internal error KeyError: 'mode'"
    assert rig.outputs.options == rig.options
    rig.failing.clear()
    rig.run(1)
    assert rig.outputs.summary() == "one, two, must"
    assert (rig.outputs.change_to("one", Switch(enabled=False)), rig.outputs.summary()) == ("", "two, must")


@pytest.mark.parametrize("method", ["tick", "close", ""])
def test_the_end_closes_all_outputs_and_returns_the_first_error(rig: Rig, method: str) -> None:
    rig.start()
    error = ValueError(method) if method else None
    if error is not None:
        rig.failing = {("one", method): error, ("two", "close"): OSError()}
    assert rig.outputs.close() is error
    assert rig.done("tick", "close") == [(name, step) for name in ("one", "two", "must") for step in ("tick", "close")]


def test_an_exception_in_an_output_of_the_program_reaches_the_program(rig: Rig) -> None:
    asked = Mock()
    outputs = Outputs(
        publisher_context(latencies=asked), {"mine": cast("Publisher", FakeOutput(rig, "mine"))}, ThreadScopes()
    )
    outputs.start({})
    assert asked.mock_calls == [call.ask("mine", 0)]
    rig.failing[("mine", "publish")] = ValueError("mine")
    with pytest.raises(ValueError, match="mine"):
        outputs.publish(BATCH)


def test_an_output_that_is_off_is_not_imported() -> None:
    program = """
import sys
from imud.config import parse
from imud.publishers import PUBLISHERS
config = parse("devices: {}", "f")
assert not PUBLISHERS["rules"].wanted(config.publishers["rules"])
print([name for name in sys.modules if name in ("imud.publishers.rules.publisher", "imud.publishers.rules.commands")])
"""
    assert subprocess.check_output([sys.executable, "-c", program], text=True) == "[]\n"
