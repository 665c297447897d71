"""A simulated host: commands change its state, and ports have simulated devices."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import pytest

from imud.cli.doctor.surroundings import CommandOutput, DaemonReply
from imud.cli.probe import ProbeReport
from imud.cli.setup.hardware import Attached, Finders
from imud.cli.setup.steps import Conversation, SetupSteps
from imud.model.errors import LinkMissing
from tests.support.surroundings import Machine

GROUPS: Final = "root:x:0:\nimud:x:990:\nimud-control:x:991:\n"


class LivingMachine(Machine):
    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self.uid = 0
        self.units: dict[str, list[str]] = {"imud.service": ["disabled", "inactive"]}
        self.started = "/usr/bin/imud run --config /etc/imud.yaml"
        self.ran: list[str] = []
        self.failing: dict[str, str] = {}
        self.missing: set[str] = set()
        for folder in ("/run/systemd/system", "/run/udev", "/etc/udev/rules.d", "/dev", "/proc", "/sys/class/tty"):
            (self.root / folder[1:]).mkdir(parents=True)
        self.write("/etc/group", GROUPS)

    def ask(self) -> DaemonReply:
        if self.units.get("imud.service", ["", ""])[1] != "active":
            raise LinkMissing("no daemon at /run/imud/imud.sock")
        return super().ask()

    def run(self, words: Sequence[str]) -> CommandOutput:
        line = " ".join(words)
        if words[0] in self.missing:
            raise FileNotFoundError(2, "No such file or directory", words[0])
        if any(line.startswith(begin) for begin in self.failing):
            self.ran.append(line)
            return CommandOutput(1, "", next(why for begin, why in self.failing.items() if line.startswith(begin)))
        if words[0] == "systemctl":
            return self._systemctl(list(words[1:]))
        if words[0] in ("udevadm", "networkctl", "ip"):
            self.ran.append(line)
            return CommandOutput(0, "", "")
        if words[0] in ("usermod", "gpasswd", "getent"):
            return self._groups(list(words))
        if words[0] in ("cat", "true"):
            return CommandOutput(0, (self.root / words[1][1:]).read_text() if words[1:] else "", "")
        return super().run(words)

    def _systemctl(self, words: list[str]) -> CommandOutput:
        verb, unit = words[0], next(word for word in words[1:] if not word.startswith("-"))
        known = unit in self.units
        enabled, active = state = self.units.get(unit, ["", "inactive"])
        if verb == "show":
            load = "loaded" if known else "not-found"
            lines = (f"LoadState={load}", f"UnitFileState={enabled}", f"ActiveState={active}",
                     f"ExecStart={{ path=/usr/bin/imud ; argv[]={self.started} ; ignore_errors=no }}")  # fmt: skip
            return CommandOutput(0, "\n".join(lines), "")
        if verb == "is-enabled":
            return CommandOutput(0 if enabled == "enabled" else 1, enabled + "\n", "")
        if verb == "is-active":
            return CommandOutput(0 if active == "active" else 3, active + "\n", "")
        self.ran.append(" ".join(["systemctl", *words]))
        if not known:
            return CommandOutput(5, "", f"Unit {unit} not found.")
        if verb in ("enable", "disable", "mask", "unmask"):
            state[0] = {"enable": "enabled", "mask": "masked"}.get(verb, "disabled")
        if verb in ("start", "restart") or (verb == "enable" and "--now" in words):
            state[1] = "active"
        if verb == "stop" or (verb in ("disable", "mask") and "--now" in words):
            state[1] = "inactive"
        return CommandOutput(0, "", "")

    def _groups(self, words: list[str]) -> CommandOutput:
        group = words[3] if words[0] != "getent" else words[2]
        lines = (self.root / "etc/group").read_text().splitlines()
        line = next(line for line in lines if line.startswith(f"{group}:"))
        if words[0] == "getent":
            return CommandOutput(0, line, "")
        self.ran.append(" ".join(words))
        head, _, listed = line.rpartition(":")
        names = [name for name in listed.split(",") if name]
        names = [*names, words[4]] if words[0] == "usermod" else [name for name in names if name != words[2]]
        text = "\n".join(f"{head}:{','.join(names)}" if one == line else one for one in lines)
        self.write("/etc/group", text + "\n")
        return CommandOutput(0, "", "")

    def usb_port(self, name: str, by_id: str = "", *, driver: str = "ftdi_sio", serial: str = "A1") -> None:
        adapter = self.root / f"sys/devices/usb1/1-{name}"
        port = adapter / "1.0" / name
        port.mkdir(parents=True)
        texts = {"idVendor": "0403", "idProduct": "6001", "product": "FT232R USB UART", "serial": serial}
        for key, text in texts.items():
            if text:
                (adapter / key).write_text(text + "\n")
        (self.root / f"sys/bus/usb-serial/drivers/{driver}").mkdir(parents=True, exist_ok=True)
        (port / "driver").symlink_to(self.root / f"sys/bus/usb-serial/drivers/{driver}")
        self.write(f"/dev/{name}")
        (self.root / f"sys/class/tty/{name}").mkdir()
        (self.root / f"sys/class/tty/{name}/device").symlink_to(port)
        if by_id:
            folder = self.root / "dev/serial/by-id"
            folder.mkdir(parents=True, exist_ok=True)
            (folder / by_id).symlink_to(f"../../{name}")

    def uart(self, name: str, *, console: bool = False) -> None:
        self.write(f"/dev/{name}")
        self.write(f"/sys/class/tty/{name}/type", "32\n")
        if console:
            self.write("/sys/class/tty/console/active", f"tty0 {name}\n")
            self.units[f"serial-getty@{name}.service"] = ["disabled", "active"]

    def can(self, name: str, *, up: bool = False) -> None:
        self.write(f"/sys/class/net/{name}/type", "280\n")
        self.write(f"/sys/class/net/{name}/flags", "0x1\n" if up else "0x0\n")

    def files(self) -> dict[str, tuple[str, int]]:
        """Return content and mode of every file that setup can change."""
        found = {}
        for top in ("etc", "boot", "var"):
            for path in sorted((self.root / top).rglob("*")):
                if path.is_file():
                    found[str(path.relative_to(self.root))] = (path.read_text(), path.lstat().st_mode)
        return found


class Attachments:
    def __init__(self) -> None:
        self.heard: dict[str, list[ProbeReport]] = {}
        self.listened: list[str] = []
        self.active: set[str] = set()
        self.lines: dict[str, list[Attached]] = {}
        self.buses: dict[str, list[Attached]] = {}

    def hears(self, place: str, driver: str, device: str = "", baud: int = 115200) -> None:
        self.heard.setdefault(place, []).append(ProbeReport(place, "", driver, device, baud))

    def listen(self, places: Sequence[str], active: set[str]) -> list[ProbeReport]:
        self.listened += places
        self.active |= active
        silent = "nothing is heard"
        return [r for place in places for r in self.heard.get(place, [ProbeReport(place, problem=silent)])]

    def finders(self) -> Finders:
        return Finders(
            self.listen, lambda path, _baud: self.lines.get(path, []), lambda kind, bus: self.buses.get(kind + bus, [])
        )


class Setup:
    def __init__(self, machine: LivingMachine, attachments: Attachments, capsys: pytest.CaptureFixture[str]) -> None:
        self.machine, self.attachments = machine, attachments
        self._capsys = capsys
        self.time_s = 0.0
        self.slept: list[float] = []

    def steps(self, *, dry_run: bool = False, user: str = "", ask: bool = False, date: str = "DATE") -> SetupSteps:
        return SetupSteps(
            self.machine.surroundings, Conversation(ask=ask), self.attachments.finders(), lambda: self.time_s,
            self.sleep, dry_run=dry_run, user=user, date=date,
        )  # fmt: skip

    def sleep(self, s: float) -> None:
        self.time_s += s
        self.slept.append(s)

    def said(self) -> str:
        return " ".join(self._capsys.readouterr().out.split())


@pytest.fixture
def machine(tmp_path: Path) -> LivingMachine:
    return LivingMachine(tmp_path)


@pytest.fixture
def attachments() -> Attachments:
    return Attachments()


@pytest.fixture
def setup(machine: LivingMachine, attachments: Attachments, capsys: pytest.CaptureFixture[str]) -> Setup:
    return Setup(machine, attachments, capsys)


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """Answers by a part of the question. Other questions get their default. The test must use all answers."""
    given: dict[str, str] = {}
    used: set[str] = set()

    def answer(question: str) -> str:
        for part, word in given.items():
            if part in question:
                used.add(part)
                return word
        return ""

    monkeypatch.setattr("builtins.input", answer)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    yield given
    assert used == set(given)
