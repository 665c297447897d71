"""The program that boots Debian: options, command line of QEMU, requests of the guest, image's parts, packages."""

import json
import os
import platform
import shutil
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.lab.host.environment import ROOT
from tests.lab.host.errors import LabError
from tests.lab_debian.host import __main__ as program
from tests.lab_debian.host import image, packages, requests
from tests.lab_debian.host.machine import DebianMachine, Qmp
from tests.lab_debian.host.release import AMD64, ARM64, MODULES, PYTHONS, Release
from tests.lab_host.conftest import FakeProgram, fake_program

__all__ = ["fake_program"]

RUN = ROOT / "tests" / "lab_debian" / "run"
BOOKWORM, TRIXIE = AMD64


# --- options and exit status ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--frob"], "lab-debian: unrecognized arguments: --frob (tests/lab/run --help)\n"),
        (["--arm64", "--suite", "bookworm"], "lab-debian: there is no bookworm for arm64, only trixie\n"),
        (["unit-tests"], "lab-debian: unit-tests are for an architecture that the host has not: --arm64\n"),
    ],
)
def test_bad_options_are_one_line(arguments: list[str], line: str) -> None:
    result = subprocess.run([RUN, *arguments], capture_output=True, text=True, timeout=30, check=False)
    assert (result.returncode, result.stdout) == (10, "")
    assert result.stderr == line


@pytest.mark.parametrize("ci", [True, False])
def test_a_machine_that_cannot_run_it_says_why_and_only_ci_succeeds(
    ci: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    if ci:
        assert program.lab(["--ci"]) == 0
        assert "left out: root is needed" in capsys.readouterr().err
    else:
        with pytest.raises(LabError, match="root is needed"):
            program.lab([])


@pytest.mark.parametrize("ci", [True, False])
def test_without_debians_packages_only_ci_succeeds(
    ci: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def built(_release: Release, _say: object) -> image.Image:
        raise LabError("no mirror answers")

    monkeypatch.setattr(packages, "obstacle", lambda _release: "")
    monkeypatch.setattr(image, "built", built)
    if ci:
        assert program.lab(["--ci", "--suite", "trixie"]) == 0
        assert "left out: no mirror answers" in capsys.readouterr().err
    else:
        with pytest.raises(LabError, match="no mirror"):
            program.lab(["--suite", "trixie"])


def test_what_is_missing_is_named(fake_program: FakeProgram, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    fake_program("apt-get", "exit 1")
    fake_program("dpkg-query", "for name in mmdebstrap e2fsprogs kmod debhelper; do echo $name installed 1; done")
    assert packages.obstacle(TRIXIE) == (
        "missing Debian packages: cpio qemu-system-x86 (make lab-debian-deps installs them)"
    )
    assert "qemu-user-static" in packages.obstacle(ARM64[0])


def test_the_releases_are_those_that_packages_are_built_for() -> None:
    script = packages.BUILD.read_text(encoding="utf-8")
    for suite, version in PYTHONS.items():
        assert f"{suite}) version={version}" in script
    assert {release.suite for release in AMD64} == PYTHONS.keys()


def test_interruption_and_signals_end_with_their_status(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_arguments: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(program, "lab", interrupted)
    before = signal.getsignal(signal.SIGTERM)
    try:
        assert program.main() == 128 + signal.SIGINT
    finally:
        signal.signal(signal.SIGTERM, before)


# --- one run, with a shell script in QEMU's place ---------------------------------------------------------------------

FAKE_QEMU = """
for word; do case $word in *mount_tag=lab*) share=${word#*path=}; share=${share%%,*};; esac; done
cat $share/script
echo '{"checks": []}' >$share/results.json
echo 'Kernel said something' >$share/console.log
"""


@pytest.fixture
def fake_rig(fake_program: FakeProgram, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Image, package, simulator and requests are there; returns options. QEMU is left to the test."""
    monkeypatch.setattr(packages, "obstacle", lambda _release: "")
    monkeypatch.setattr(image, "built", lambda _release, _say: image.Image(tmp_path, tmp_path, tmp_path))
    monkeypatch.setattr(packages, "next_version", lambda _package, folder: folder / "next.deb")
    package = tmp_path / "imud.deb"
    package.touch()
    return ["--package", str(package), "--output", str(tmp_path / "out"), "--suite", "trixie"]


@pytest.fixture
def no_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither a simulated sensor nor a thread that answers requests."""
    monkeypatch.setattr(program, "simulator", lambda _python, _node: _nothing())
    monkeypatch.setattr(requests, "answered", lambda _sockets, _pid: _nothing())


class _nothing:
    def __enter__(self) -> None:
        return None

    def __exit__(self, *_reason: object) -> None:
        return None


@pytest.mark.usefixtures("no_devices")
def test_the_guests_status_is_the_rigs_and_a_failure_keeps_the_logs(
    fake_program: FakeProgram, fake_rig: list[str], tmp_path: Path, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    fake_program(TRIXIE.qemu, f"{FAKE_QEMU}\necho 1 >$share/status")
    assert program.lab([*fake_rig, "replug"]) == 1
    captured = capfdbinary.readouterr()
    assert captured.out == b"exec python3 -B -m tests.lab_debian.guest amd64 replug\n"
    assert b"the guest ran" in captured.err
    assert set(os.listdir(tmp_path / "out" / "trixie-amd64")) == {"console.log", "results.json"}


@pytest.mark.usefixtures("no_devices")
def test_the_guest_finds_its_program_and_both_packages(fake_program: FakeProgram, fake_rig: list[str]) -> None:
    look = "cd $share && [ -e tests/lab_debian/guest/__main__.py ] && [ -e imud.deb ] && [ ! -e tree ]"
    fake_program(TRIXIE.qemu, f"{FAKE_QEMU}\n{look} && echo 0 >$share/status")
    assert program.lab(fake_rig) == 0


@pytest.mark.usefixtures("no_devices")
def test_a_guest_without_a_result_is_the_rigs_failure(fake_program: FakeProgram, fake_rig: list[str]) -> None:
    fake_program(TRIXIE.qemu, f"{FAKE_QEMU}\necho 'Kernel panic - not syncing: oh' >$share/console.log")
    with pytest.raises(LabError, match="kernel panic in the guest"):
        program.lab(fake_rig)


def test_a_simulator_that_does_not_start_is_one_line(tmp_path: Path) -> None:
    with (
        pytest.raises(LabError, match="the simulated sensor did not start"),
        program.simulator(Path("/bin/false"), tmp_path / "n"),
    ):
        pass


# --- the machine ------------------------------------------------------------------------------------------------------


def machine(release: Release, share: str = "/out/run-1") -> list[str]:
    """The argument vector of QEMU."""
    made = image.Image(Path("/i/disk"), Path("/i/kernel"), Path("/i/initramfs"))
    return DebianMachine(release, made, Path(share), Path("/tmp/s")).command(7)


@pytest.mark.parametrize("release", [*AMD64, *ARM64], ids=lambda release: str(release.name))
def test_processors_are_emulated_and_the_disk_stays_as_it_is(release: Release) -> None:
    arguments = machine(release)
    assert arguments[0] == release.qemu
    assert arguments[arguments.index("-accel") + 1].startswith("tcg")
    (disk,) = (argument for argument in arguments if "file=/i/disk" in argument)
    assert "snapshot=on" in disk
    assert "-no-reboot" in arguments


def test_the_adapter_is_there_from_the_start_and_comes_back_the_same() -> None:
    assert "usb-serial,chardev=imu,id=imu,bus=xhci.0,serial=LAB0001" in machine(TRIXIE)


def test_commas_in_paths_are_doubled() -> None:
    assert any("path=/o,,ut/run-1,mount_tag=lab" in argument for argument in machine(TRIXIE, "/o,ut/run-1"))


def test_amd64_has_what_the_modules_of_its_buses_look_for() -> None:
    arguments = machine(TRIXIE)
    names = [arguments[i + 1] for i, word in enumerate(arguments) if word == "-smbios"]
    assert names == ["type=1,manufacturer=PC Engines", "type=2,product=apu2"]
    assert "isa-parallel,chardev=parallel" in arguments
    assert {"pcengines-apuv2", "spi-butterfly"} <= set(MODULES)
    assert not {"-smbios", "isa-parallel,chardev=parallel"} & set(machine(ARM64[0]))


class FakeQemu:
    """QEMU's control socket: greets, answers, and sends the event of a removed device a little later."""

    def __init__(self, path: Path, *, refuses: bool = False) -> None:
        self.asked: list[str] = []
        self._refuses = refuses
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        connection, _ = self._listener.accept()
        with connection, connection.makefile("rw", encoding="utf-8") as lines:
            self._say(lines, {"QMP": {}})
            while line := lines.readline():
                command = json.loads(line)
                self.asked.append(command["execute"])
                if self._refuses and command["execute"] != "qmp_capabilities":
                    self._say(lines, {"error": {"desc": "no such device"}})
                    continue
                self._say(lines, {"event": "OTHER"})
                self._say(lines, {"return": {}})
                if command["execute"] == "device_del":
                    self._say(lines, {"event": "DEVICE_DELETED", "data": {"path": "/machine/imu"}})

    def _say(self, lines: object, message: object) -> None:
        lines.write(json.dumps(message) + "\n")  # type: ignore[attr-defined]
        lines.flush()  # type: ignore[attr-defined]

    def close(self) -> None:
        """End it; the client has closed."""
        self._thread.join(20)
        self._listener.close()
        assert not self._thread.is_alive()


@pytest.fixture
def qmp_path(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A path that is short enough for a socket."""
    folder = Path(os.environ.get("TMPDIR", "/tmp")) / f"imud-qmp-{os.getpid()}"
    folder.mkdir()
    yield folder / "qmp"
    shutil.rmtree(folder)


def test_unplug_returns_when_the_device_is_gone_and_plug_brings_it_back(qmp_path: Path) -> None:
    qemu = FakeQemu(qmp_path)
    with Qmp(qmp_path) as qmp:
        qmp.unplug()
        qmp.plug()
    qemu.close()
    assert qemu.asked == ["qmp_capabilities", "device_del", "device_add"]


def test_what_qemu_refuses_is_an_error(qmp_path: Path) -> None:
    qemu = FakeQemu(qmp_path, refuses=True)
    with Qmp(qmp_path) as qmp, pytest.raises(LabError, match=r"QEMU refused device_del: .*no such device"):
        qmp.unplug()
    qemu.close()


def test_nobody_at_the_socket(tmp_path: Path) -> None:
    with pytest.raises(LabError, match="nobody listens"):
        Qmp(tmp_path / "none", limit_s=0.0)


# --- requests of the guest --------------------------------------------------------------------------------------------


def test_requests_are_answered_in_order() -> None:
    done = []

    def refuse() -> None:
        raise LabError("QEMU refused")

    ours, guest = socket.socketpair()
    with guest, guest.makefile("rb") as lines:
        guest.sendall(b"plug\nunplug\nfly\n")
        guest.shutdown(socket.SHUT_WR)
        with ours:
            requests.serve(ours, {"plug": lambda: done.append("plug"), "unplug": refuse})
        assert lines.read() == b"ok\nQEMU refused\nexpected one of plug, unplug, got 'fly'\n"
    assert done == ["plug"]


def test_the_sensor_is_stopped_while_the_adapter_is_pulled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(requests, "DRAIN_S", 0.0)
    sensor = subprocess.Popen(["sleep", "60"])

    def pull() -> None:
        assert os.WIFSTOPPED(os.waitpid(sensor.pid, os.WUNTRACED)[1])
        raise LabError("QEMU refused")

    with pytest.raises(LabError, match="QEMU refused"):
        requests.unplug_quietly(pull, sensor.pid)
    assert os.WIFCONTINUED(os.waitpid(sensor.pid, os.WCONTINUED)[1])
    sensor.kill()
    sensor.wait()


# --- images -----------------------------------------------------------------------------------------------------------


def test_the_key_of_an_image_is_its_own() -> None:
    keys = {image.key(release) for release in (*AMD64, *ARM64)}
    assert len(keys) == len(AMD64) + len(ARM64)
    assert image.key(TRIXIE) == image.key(TRIXIE)


def test_the_key_changes_with_every_file_of_the_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = image.key(TRIXIE)
    copied = shutil.copytree(image.ROOT_FILES, tmp_path / "root")
    monkeypatch.setattr(image, "ROOT_FILES", Path(copied))
    assert image.key(TRIXIE) == before
    (tmp_path / "root" / "usr/local/sbin/lab").write_text("#!/bin/sh\n", encoding="ascii")
    assert image.key(TRIXIE) != before


APT = """\
echo bookworm http://mirror/debian/
echo bookworm-updates http://mirror/debian/
echo bookworm-security http://mirror/security/
"""


def test_archives_are_those_of_the_hosts_apt(fake_program: FakeProgram) -> None:
    fake_program("apt-get", APT)
    assert image.archives() == ("http://mirror/debian/", "http://mirror/security/")


@pytest.mark.parametrize("lines", [APT.splitlines()[:2], APT.splitlines()[2:], []])
def test_a_host_without_an_archive_is_one_line(fake_program: FakeProgram, lines: list[str]) -> None:
    fake_program("apt-get", "\n".join(lines))
    with pytest.raises(LabError, match="apt knows no Debian archive"):
        image.archives()


def test_modules_come_in_the_order_of_loading_and_once(
    fake_program: FakeProgram, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = fake_program(
        "modprobe",
        "for name; do :; done; [ $name = none ] && exit 1\n"
        'echo "insmod /m/base.ko"; echo "insmod /m/$name.ko.xz "; echo builtin x',
    ).parent
    monkeypatch.setitem(image.CLEAN, "PATH", f"{folder}:{os.environ['PATH']}")
    found = image.files_of(Path("/tree"), "6.1", ("one", "none", "two"))
    assert found == [Path("/m/base.ko"), Path("/m/one.ko.xz"), Path("/m/two.ko.xz")]


def test_a_step_that_fails_is_named_with_its_last_line(tmp_path: Path) -> None:
    log = tmp_path / "build.log"
    image.step(["sh", "-c", "cat; echo fine"], log, "input\n")
    with pytest.raises(LabError, match="sh failed: oh"):
        image.step(["sh", "-c", "echo oh; echo; exit 3"], log)
    assert "input\nfine" in log.read_text(encoding="utf-8")


def test_nothing_of_the_hosts_environment_reaches_a_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PIP_INDEX_URL", "http://elsewhere")
    image.step(["sh", "-c", "env"], tmp_path / "log")
    assert "elsewhere" not in (tmp_path / "log").read_text(encoding="utf-8")


STATUS = """\
Package: libc6
Status: install ok installed
Architecture: amd64
Version: 2.41-12

Package: tzdata
Status: install ok installed
Architecture: all
Version: 2025b-4
"""


def write(root: Path, files: dict[str, str]) -> None:
    """Files of a root file system."""
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="ascii")


def test_a_root_of_another_architecture_keeps_what_was_set_up_and_has_the_others_programs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, records = tmp_path / "root", "var/lib/dpkg"
    write(root, {
        f"{records}/status": STATUS, f"{records}/info/libc6:amd64.list": "/usr/lib/x86_64-linux-gnu/libc.so.6\n",
        f"{records}/info/libc6:amd64.postinst": "#!/bin/sh\n", "usr/lib/x86_64-linux-gnu/libc.so.6": "ours",
        "usr/lib64/ld.so": "ours", "usr/bin/true": "ours", "etc/passwd": "made by a script", "etc/ld.so.cache": "ours",
    })  # fmt: skip
    (root / "lib64").symlink_to("usr/lib64")
    asked: list[tuple[str, ...]] = []

    def unpacked(_release: Release, folder: Path, _log: Path, variant: str, names: tuple[str, ...]) -> None:
        asked.append((variant, *names))
        theirs = {"usr/bin/true": "theirs", "usr/lib/aarch64-linux-gnu/libc.so.6": "theirs", f"{records}/status": ""}
        write(folder, theirs)

    monkeypatch.setattr(image, "bootstrap", unpacked)
    image.exchange(ARM64[0], root, tmp_path / "other", tmp_path / "log")
    assert asked == [("extract", "libc6", "tzdata")]
    left = {str(path.relative_to(root)): path.read_text() for path in root.rglob("*") if path.is_file()}
    assert left == {
        f"{records}/status": STATUS.replace("amd64", "arm64"),
        f"{records}/info/libc6:arm64.list": "/usr/lib/aarch64-linux-gnu/libc.so.6\n",
        f"{records}/info/libc6:arm64.postinst": "#!/bin/sh\n",
        "usr/lib/aarch64-linux-gnu/libc.so.6": "theirs", "usr/bin/true": "theirs", "etc/passwd": "made by a script",
    }  # fmt: skip
    assert not (root / "lib64").is_symlink()


# --- packages ---------------------------------------------------------------------------------------------------------


def test_the_package_of_an_upgrade_is_later() -> None:
    control = packages.later("Package: imud\nVersion: 0.1.0-1~trixie\nArchitecture: amd64\n")
    assert control == "Package: imud\nVersion: 0.1.0-1~trixie+lab1\nArchitecture: amd64\n"
    with pytest.raises(LabError, match="0 versions"):
        packages.later("Package: imud\n")


def test_a_package_that_cannot_be_made_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "build"
    script.write_text("#!/bin/sh\necho out; echo oh >&2; exit 1\n", encoding="ascii")
    script.chmod(0o755)
    monkeypatch.setattr(packages, "BUILD", script)
    with pytest.raises(LabError, match="the package cannot be made: oh"):
        packages.build(TRIXIE, Path("python"))


def test_deps_install_what_is_missing(fake_program: FakeProgram, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []
    monkeypatch.setattr(packages, "install", asked.append)
    fake_program("dpkg-query", "echo kmod installed 1")
    assert packages.main(["amd64"]) == 0
    assert asked == [["mmdebstrap", "e2fsprogs", "cpio", "debhelper", "qemu-system-x86"]]
    assert packages.main(["sparc"]) == 1
