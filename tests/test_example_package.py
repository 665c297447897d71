"""The package of docs/drivers.md, built and installed as on the page, and packages with problems."""

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from imud.cli.demo import simulator
from imud.client.connection import Client
from tests.support.daemon_process import running_daemon, wait_until, write_config
from tests.support.plugin_package import write_package

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs/drivers.md").read_text()
FILES = dict(re.findall(r"^### `([^`]+)`\n\n```\w+\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL))
(CONFIGURATION,) = re.findall(r"^```yaml\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
COMMANDS = [
    shlex.split(line, comments=True)[1:] for line in re.findall(r"^imud [^#&\n]*", PAGE.partition("\n## ")[0], re.M)
]
PARSE = (
    "import json, sys; from imud.cli import build_parser as b; [b().parse_args(one) for one in json.loads(sys.argv[1])]"
)
FRAME = bytes.fromhex("E751 0700 E803 0000 5026 18FC 0000 0000 C409 C89B D5EC")

BROKEN = "open(f'{__file__}.imported', 'w').close()\nraise TypeError('missing argument')\n"

pytestmark = pytest.mark.live


def run(*words: str | Path, status: int = 0, folder: Path | None = None) -> str:
    """Run `python -m WORDS` and return its output, with the standard error at the end."""
    done = subprocess.run(
        [sys.executable, "-m", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        check=False,
    )
    assert done.returncode == status, done.stdout + done.stderr
    return done.stdout + done.stderr


def imud(*words: str | Path, status: int = 0) -> str:
    return run("imud", *words, status=status)


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, source: Path) -> None:
    """Build a wheel, and install it in an environment like /usr/lib/imud of the Debian package, which has no pip."""
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    site = folder / f"lib/python{version}/site-packages"
    (folder / "bin").mkdir()
    site.mkdir(parents=True)
    python = Path(sys.executable).resolve()
    (folder / "bin/python3").symlink_to(python)
    (folder / "pyvenv.cfg").write_text(f"home = {python.parent}\ninclude-system-site-packages = false\n")
    run("pip", "wheel", "--no-deps", "--no-index", "--no-build-isolation", source, folder=folder)
    (wheel,) = folder.glob("*.whl")
    run("pip", "--python", folder / "bin/python3", "install", "--no-deps", "--no-index", wheel, folder=folder)
    use(site, monkeypatch)


def use(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let new processes use the packages in a folder."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), str(site)]))
    monkeypatch.delenv("IMUD_PLUGINS")


def test_the_example_package_takes_part_in_everything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source, capture, csv = tmp_path / "imud-example", tmp_path / "capture.bin", tmp_path / "samples.csv"
    for name, text in FILES.items():
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).write_text(text)
    (tmp_path / "environment").mkdir()
    install(tmp_path / "environment", monkeypatch, source)

    capture.write_bytes(FRAME[5:] + FRAME * 2)
    decoded = [json.loads(line) for line in imud("decode", "--driver", "example-uart", capture).splitlines()]
    assert [line["accel_m_s2"] for line in decoded[:2]] == [pytest.approx([1.0, 0.0, 9.808])] * 2
    assert (decoded[-1]["frames_in_samples"], decoded[-1]["bytes_skipped"]) == (2, len(FRAME) - 5)
    assert "the ledger balances" in imud("demo", "--device", "example-uart", "--duration", "1", "--plain")

    device = {"driver": "example-uart", "uart": {"port": str(tmp_path / "port")}}
    output: dict[str, Any] = {"example-csv": {"enabled": True, "path": str(csv)}}
    with simulator(tmp_path, [("example-uart", 0)], 100.0, ""):
        assert "example-uart at 115200 baud" in imud("probe", tmp_path / "port")
        with running_daemon(tmp_path, {"bow": device}, **output) as daemon:
            daemon.wait_for("bow", "running")
            wait_until(lambda: csv.exists() and csv.read_text().count("\n") > 20, "lines in the file")
    rows = [line.split(",") for line in csv.read_text().splitlines()]
    assert [(name, int(seq)) for name, seq, *_ in rows] == [("bow", number + 1) for number in range(len(rows))]
    assert all(8 < sum(float(value) ** 2 for value in row[3:]) ** 0.5 < 12 for row in rows)

    (tmp_path / "page.yaml").write_text(CONFIGURATION)
    assert "valid; devices: bow" in imud("check", tmp_path / "page.yaml")
    assert [words[0] for words in COMMANDS] == ["decode", "sim", "probe", "demo"]
    subprocess.run([sys.executable, "-c", PARSE, json.dumps(COMMANDS)], check=True)
    config = write_config(tmp_path, {"bow": device}, **output)
    assert "valid; devices: bow" in imud("check", config)
    wrong = write_config(tmp_path, {"bow": device}, **{"example-csv": {"enable": True}})
    assert "example-csv.enable: expected a key that imud knows" in imud("check", wrong, status=2)
    monkeypatch.setenv("IMUD_PLUGINS", "off")
    assert 'expected a driver that imud knows, got "example-uart"' in imud("check", config, status=2)
    monkeypatch.delenv("IMUD_PLUGINS")
    assert " passed" in run("pytest", "-q", "tests", folder=source)


def test_a_package_with_a_problem_stops_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = dict.fromkeys(("old-uart", "old-csv"), "old_example:ROW")
    groups = {"imud.drivers": names, "imud.outputs": names, "imud.simulators": names}
    write_package(tmp_path / "site", "old-example", groups, {"old_example.py": BROKEN})
    use(tmp_path / "site", monkeypatch)
    imud("status", "--socket", tmp_path / "imud.sock", status=2)
    assert not (tmp_path / "site/old_example.py.imported").exists(), "a command that needs no driver"
    capture = tmp_path / "capture.bin"
    capture.write_bytes(b"")
    link = {"replay": {"path": str(capture), "speed": "maximum"}}
    devices = {"bow": {"driver": "old-uart", **link}, "mast": {"driver": "hipnuc-uart", **link}}
    output: dict[str, Any] = {"old-csv": {"enabled": True}}
    config = write_config(tmp_path, devices, **output)
    why = "of old-example 1.0: expected the object old_example:ROW, got TypeError: missing argument; install a version"
    found: dict[str, Sequence[str]] = {}
    with running_daemon(tmp_path, devices, **output) as daemon:
        assert daemon.statuses().keys() == {"mast"}
        found["log"] = [(tmp_path / "log").read_text()]
    found["check"] = [imud("check", config, status=1)]
    report = msgspec.json.decode(imud("doctor", "--config", config, "--json", status=2))
    found["doctor"] = [value for one in report["checks"][0]["findings"] for value in map(str, one.values())]
    for words in found.values():
        text = "\n".join(words)
        assert f"devices.bow.driver: imud ignores this device: cannot use the driver old-uart {why}" in text
        assert f"old-csv: imud ignores this output: cannot use the output old-csv {why}" in text
    assert f"cannot use the driver old-uart {why}" in imud("decode", "--driver", "old-uart", capture, status=2)
    assert f"cannot use the simulator old-uart {why}" in imud("demo", "--device", "old-uart", status=2)
    assert "hipnuc-uart" in imud("schema")


FAILING = """
import os, threading
from dataclasses import replace
from imud.drivers import DRIVERS
from imud.drivers.imu61x.uart.codec import Imu61xCodec

class Codec(Imu61xCodec):
    def feed(self, data):
        threading.Thread(target=threading.Event().wait, name="never ends").start()
        raise ERROR

    def reset(self):
        raise ERROR

ROW = replace(DRIVERS["imu61x-uart"], name="failing", interface=1, make_codec=Codec)
"""


@pytest.mark.parametrize("error", ["OverflowError('too large')", "SystemExit(0)"])
def test_a_driver_that_raises_ends_only_its_devices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: str
) -> None:
    """SystemExit(0) ended the daemon with status 0, and a failing `reset` ended all devices."""
    points = {"imud.drivers": {"failing": "failing_example:ROW"}}
    files = {"failing_example.py": FAILING.replace("ERROR", error)}
    write_package(tmp_path / "site", "failing-example", points, files)
    use(tmp_path / "site", monkeypatch)
    capture = tmp_path / "capture.bin"
    capture.write_bytes(bytes(100))
    name = error.partition("(")[0]
    words_of_driver = f"the driver failing of another package failed: internal error {name}: "
    assert words_of_driver in imud("decode", "--driver", "failing", capture, status=1)
    devices = {
        "bow": {"driver": "failing", "replay": {"path": str(capture), "speed": "maximum"}},
        "mast": {"uart": {"port": str(tmp_path / "port")}},
    }
    file = tmp_path / "imud.yaml"
    with simulator(tmp_path, [("hipnuc-uart", 0)], 100.0, ""):
        assert "hipnuc-uart at 115200 baud" in imud("probe", tmp_path / "port")
        write_config(tmp_path, devices)
        words = [sys.executable, "-m", "imud", "run", "--config", str(file)]
        with (tmp_path / "log").open("w") as log, subprocess.Popen(words, stderr=log) as process:
            try:
                wait_until(lambda: "mast: hipnuc-uart on" in (tmp_path / "log").read_text(), "mast")
                with Client(tmp_path / "imud.sock") as client:
                    status = client.status()
                states = {device["name"]: (device["state"], device["problem"]) for device in status["devices"]}
                assert states["mast"] == ("running", "")
                assert states["bow"][0] == "failed"
                assert states["bow"][1].startswith(words_of_driver)
                assert [(one["name"], one["running"]) for one in status["output_states"]] == [
                    ("metrics", True), ("shm", True), ("socket", True),
                ]  # fmt: skip
                events = imud("events", "--socket", tmp_path / "imud.sock", "--since", "10min")
                assert words_of_driver in " ".join(events.split())
                shown = " ".join(imud("status", "--socket", tmp_path / "imud.sock", status=1).split())
                assert f"bow: missing T{words_of_driver[1:]}" in shown
            finally:
                process.terminate()
            assert process.wait(60) == 0
    text = (tmp_path / "log").read_text()
    assert f"bow: {words_of_driver}" in text
    assert "imud continues without this device" in text
    assert "Traceback" in text
    assert "still running: never ends" in text
