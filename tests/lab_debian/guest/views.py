"""The page in the browser as a service of its own, and a daemon without its MQTT broker."""

import json
import re
from pathlib import Path

from tests.lab_debian.guest import system
from tests.lab_debian.guest.checks import Checks, Failed, expect, expect_in, wait_until
from tests.lab_debian.guest.rights import RATE_HZ
from tests.lab_debian.guest.sandbox import PRIVATE, SCORE_MAX
from tests.lab_debian.guest.service import CAN, USB

UNIT = "imud-web.service"
PORT = 9322
TOKEN = "0123456789abcdef0123456789abcdef"
TOKEN_FILE = Path("/etc/imud-web.token")
DROP_IN = Path(f"/etc/systemd/system/{UNIT}.d/lab.conf")
OPEN = f"""\
[Service]
LoadCredential=token:{TOKEN_FILE}
ExecStart=
ExecStart=/usr/bin/imud web --address 0.0.0.0 --token-file ${{CREDENTIALS_DIRECTORY}}/token
SupplementaryGroups=imud-control
"""
FETCH = """
import sys, urllib.error, urllib.request
url, token, body = sys.argv[1:]
request = urllib.request.Request(url, body.encode() or None)
request.add_header("Origin", url[:url.index("/", 7)])
if token:
    request.add_header("Authorization", "Bearer " + token)
try:
    with urllib.request.urlopen(request, timeout=20) as answer:
        print(answer.status, answer.read().decode())
except urllib.error.HTTPError as error:
    print(error.code, error.read().decode())
except OSError as error:
    print(0, error)
"""
"""Program that sends a request as the page does. It prints status and text of the reply; 0 without a reply."""
LOOK = json.dumps({"method": "actions", "params": {"device": "usb"}})
CHANGE = json.dumps({"method": "settings.apply", "params": {"device": "usb", "settings": {"output.hi91": RATE_HZ}}})
NO_BROKER = "mqtt: {enabled: true, brokers: ['mqtt://127.0.0.1:1']}\n"
STAYS_S = 30.0


def fetch(path: str, address: str = "127.0.0.1", token: str = "", body: str = "") -> tuple[int, str]:
    """Return status and text of a reply of the web server; status 0 without a reply."""
    said = system.run("/usr/bin/python3", "-c", FETCH, f"http://{address}:{PORT}{path}", token, body).stdout
    status, _, text = said.partition(" ")
    return int(status), text


def check(checks: Checks, _host: system.Host) -> None:
    system.configure(USB + CAN)
    system.start_service()
    system.wait_streaming("usb")
    check_page(checks)
    check_confinement(checks)
    check_token(checks)
    check_no_broker(checks)
    system.configure(USB + CAN)
    system.start_service()
    system.wait_streaming("usb")


def check_page(checks: Checks) -> None:
    with checks("imud-web starts and serves its page on this host"):
        system.must("systemctl", "start", UNIT)
        wait_until(lambda: fetch("/")[0] == 200, "the page")
        expect_in("<!doctype html>", fetch("/")[1].lower(), "page")
    with checks("imud-web listens only on this host, as a user of its own"):
        listening = system.must("ss", "--listening", "--tcp", "--numeric", "--no-header", f"sport = :{PORT}")
        expect("addresses", [line.split()[3] for line in listening.splitlines()], [f"127.0.0.1:{PORT}"])
        system.must("ip", "address", "replace", f"{PRIVATE}/32", "dev", "lo")
        expect("status on another address", fetch("/", PRIVATE)[0], 0)
        process = Path(f"/proc/{system.shown('MainPID', UNIT)}/status").read_text()
        assert not re.search(r"^Uid:\t0\t", process, re.MULTILINE), "expected another user than root"
        expect_in("CapEff:\t0000000000000000", process, "status")
        expect_in("Seccomp:\t2", process, "status")
    with checks("imud-web permits no change without a token"):
        expect("who looks", fetch("/api/call", body=LOOK)[0], 200)
        expect("who changes", fetch("/api/call", body=CHANGE)[0], 401)


def check_confinement(checks: Checks) -> None:
    with checks(f"systemd-analyze security gives imud-web at most {SCORE_MAX}"):
        said = system.must("systemd-analyze", "security", "--no-pager", UNIT)
        found = re.search(r"Overall exposure level for imud-web\.service: ([\d.]+)", said)
        if found is None:
            raise Failed(said)
        checks.figure("exposure of imud-web (systemd-analyze security)", float(found[1]), "of 10")
        assert float(found[1]) <= SCORE_MAX, f"score {found[1]}"
    with checks("imud-web continues when the daemon restarts"):
        before = system.shown("MainPID", UNIT)
        system.start_service()
        system.wait_streaming("usb")
        expect("process", system.shown("MainPID", UNIT), before)
        expect("page", fetch("/")[0], 200)
    with checks("imud-web stops cleanly"):
        system.must("systemctl", "stop", UNIT)
        expect("result", system.shown("Result", UNIT), "success")
        expect("status", fetch("/")[0], 0)


def check_token(checks: Checks) -> None:
    with checks("imud-web on all addresses needs its token, and sends requests to a device with it"):
        TOKEN_FILE.write_text(f"{TOKEN}\n")
        TOKEN_FILE.chmod(0o600)
        DROP_IN.parent.mkdir(exist_ok=True)
        DROP_IN.write_text(OPEN)
        system.must("systemctl", "daemon-reload")
        try:
            system.must("systemctl", "start", UNIT)
            wait_until(lambda: fetch("/", PRIVATE)[0], "a reply on another address")
            for token in ("", TOKEN[:-1] + "x"):
                expect("a read without the token", fetch("/api/call", PRIVATE, token, LOOK)[0], 401)
                expect("a change without the token", fetch("/api/call", PRIVATE, token, CHANGE)[0], 401)
            expect_in("output_once", fetch("/api/call", PRIVATE, TOKEN, LOOK)[1], "actions")
            expect_in('"result"', fetch("/api/call", PRIVATE, TOKEN, CHANGE)[1], "reply to a change")
        finally:
            system.run("systemctl", "stop", UNIT)
            DROP_IN.unlink()
            DROP_IN.parent.rmdir()
            TOKEN_FILE.unlink()
            system.must("systemctl", "daemon-reload")


def check_no_broker(checks: Checks) -> None:
    with checks("a daemon without its MQTT broker continues, keeps its messages, and does not restart"):
        since = system.mark()
        system.configure(NO_BROKER + USB + CAN)
        system.start_service()
        before = system.pid()
        system.wait_streaming("usb")
        wait_until(lambda: "127.0.0.1:1" in system.journal(since), "the problem in the log")
        wait_until(lambda: any(Path("/var/lib/imud/mqtt").rglob("*")), "the spool")
        began = (system.device("usb") or {})["newest_seq"]
        wait_until(
            lambda: (system.device("usb") or {})["newest_seq"] > began + STAYS_S * RATE_HZ,
            f"samples of {STAYS_S} more seconds",
        )
        expect("process", system.pid(), before)
        expect("restarts", system.shown("NRestarts"), "0")
        expect("active", system.shown("ActiveState"), "active")
