"""A real daemon: a rule reaches a client of the socket, its command runs, and a reload ends it with an event."""

import signal
from pathlib import Path
from typing import Any

import pytest

from tests.support.daemon_process import running_daemon, wait_until, write_config

pytestmark = pytest.mark.live


def test_a_rule_of_a_silent_device(tmp_path: Path) -> None:
    rule: dict[str, Any] = {
        "measure": "silence_s", "above": 0.1, "hold_s": 0,
        "command": ["/bin/sh", "-c", f"echo $IMUD_DEVICE $IMUD_VALUE >{tmp_path}/ran"],
    }  # fmt: skip
    devices = {"bow": {"driver": "hipnuc-uart", "uart": {"port": str(tmp_path / "absent"), "baud": 115200}}}
    rules: dict[str, Any] = {"enabled": True, "rules": {"quiet": rule}}
    with running_daemon(tmp_path, devices, rules=rules) as daemon, daemon.client() as client:
        wait_until((tmp_path / "ran").exists, "the command ran")
        wait_until((tmp_path / "ran").read_text, "the command wrote")
        assert (tmp_path / "ran").read_text().startswith("bow 0.")
        past = client.call("events", since_ns=0, limit=100)["events"]
        (begin,) = [one for one in past if one["kind"] == "rule"]
        assert begin["message"].startswith("rule quiet: silence 0.")
        assert (begin["device"], begin["detail"]["active"], begin["detail"]["limit"]) == ("bow", True, 0.1)
        write_config(tmp_path, devices, rules={"enabled": True, "rules": {"quiet": {**rule, "above": 600}}})
        daemon.signal(signal.SIGHUP)
        events = (event for event in client.events(timeout_s=60) if event.kind == "rule")
        assert next(events).message == "rule quiet ended: the output rules ended"
