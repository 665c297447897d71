"""The complete `imud setup` on simulated hosts: first run, second run, undo, interruption.
Output of setup in 80 columns, and its questions."""

import json
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from unittest import mock
from unittest.mock import Mock, call

import pytest

from imud import config
from imud.cli.setup import changes
from imud.cli.setup import changes as journal
from imud.cli.setup.hardware import Attached, Wanted
from imud.cli.setup.steps import Conversation, attached_table, reasons, samples_table, wait_for_samples
from imud.contracts.status import DeviceState, DeviceStatus
from imud.host.files import replace_file
from imud.model.errors import BadArgument, ConfigError, ImudError, LinkMissing
from tests.cli.setup.conftest import Attachments, LivingMachine, Setup
from tests.support.files import ROOT
from tests.support.metrics import device

BY_ID = "/dev/serial/by-id/usb-FTDI_FT232R_USB_UART_A1-if00-port0"
EXAMPLE = (ROOT / "etc/imud.yaml").read_text()
PORT = Wanted()
RULES = "/etc/udev/rules.d/61-imud-setup.rules"


@pytest.fixture
def gateway(machine: LivingMachine, attachments: Attachments) -> LivingMachine:
    """A host with the installed package, a device on a USB adapter, and a user of sudo."""
    machine.usb_port("ttyUSB0", "usb-FTDI_FT232R_USB_UART_A1-if00-port0")
    machine.write("/etc/imud.yaml", EXAMPLE)
    attachments.hears(BY_ID, "hipnuc-uart")
    machine.status = [device("imu")]
    return machine


def test_a_new_gateway_is_set_up_once_and_taken_back(gateway: LivingMachine, setup: Setup) -> None:
    before = gateway.files()
    assert setup.steps(user="ann").set_up(PORT, ()) == 0
    out = setup.said()
    found = "/dev/ttyUSB0 hipnuc-uart", f"+ port: {BY_ID}", "999.5", "HI13", "0.045 ms", "All devices send samples."
    assert [words for words in found if words not in out] == []
    text = (gateway.root / "etc/imud.yaml").read_text()
    (imu,) = config.parse(text, "imud.yaml").devices
    assert (imu.name, imu.driver, imu.link_settings.port) == ("imu", "hipnuc-uart", BY_ID)  # type: ignore[attr-defined]
    example = EXAMPLE.splitlines()
    assert set(example) - set(text.splitlines()) < set(example[example.index("devices:") :][:16])
    assert (gateway.root / "etc/imud.yaml.DATE").read_text() == EXAMPLE
    assert 'ATTR{latency_timer}="1"' in (gateway.root / "etc/udev/rules.d/61-imud-setup.rules").read_text()
    assert gateway.units["imud.service"] == ["enabled", "active"]
    assert "imud:x:990:ann\n" in (gateway.root / "etc/group").read_text()

    after, ran = gateway.files(), list(gateway.ran)
    setup.attachments.listened.clear()
    assert setup.steps(user="ann", date="LATER").set_up(PORT, ()) == 0
    out = setup.said()
    assert "No changes needed." in out
    assert "Changes:" not in out
    assert setup.attachments.listened == []  # the daemon uses the port
    assert (gateway.files(), gateway.ran) == (after, ran)

    assert setup.steps().undo() == 0
    assert setup.said() == (
        "Undo, newest change first: - systemctl stop imud.service - systemctl disable imud.service - gpasswd --delete "
        "ann imud - restore /etc/imud.yaml (add device imu) - remove /etc/imud.yaml.DATE (backup of /etc/imud.yaml) - "
        "remove /etc/udev/rules.d/61-imud-setup.rules (set the latency timer of adapters to 1 ms) imud undid all "
        "changes of `imud setup`."
    )
    assert (gateway.files(), gateway.units["imud.service"]) == (before, ["disabled", "inactive"])
    assert setup.steps().undo() == 0
    assert "there are no changes to undo" in setup.said()


def test_a_dry_run_changes_nothing_and_tells_all(gateway: LivingMachine, setup: Setup) -> None:
    before = gateway.files()
    steps = setup.steps(dry_run=True, user="ann")
    assert (steps.set_up(PORT, ()), gateway.files(), gateway.ran) == (0, before, [])
    out = setup.said()
    for words in ("device imu", "61-imud-setup.rules (new)", "usermod --append --groups imud ann",
                  "systemctl enable imud.service", "systemctl restart imud.service"):  # fmt: skip
        assert words in out
    said = json.loads(steps.as_json())
    assert (len(said["changes"]), said["found"][0]["keys"]) == (6, {"driver": "hipnuc-uart", "uart": {"port": BY_ID}})
    assert said["made"] is False


def test_what_a_person_wrote_stays_and_devices_are_added(gateway: LivingMachine, setup: Setup) -> None:
    mine = "log_level: debug  # mine\ndevices:\n  bow:  # on the mast\n    uart: {port: /dev/ttyUSB7}\n"
    gateway.write("/etc/imud.yaml", mine)
    gateway.can("can0", up=True)
    setup.attachments.hears("can0", "hipnuc-canopen", "node 8", 500000)
    gateway.status = [device("bow", state=DeviceState.MISSING, problem="it is away"), device("imu"), device("imu2")]
    assert setup.steps().set_up(PORT, (), wait_s=2) == 1  # bow is still missing
    text = (gateway.root / "etc/imud.yaml").read_text()
    assert [line for line in mine.splitlines() if line not in text.splitlines()] == []
    devices = {one.name: one for one in config.parse(text, "imud.yaml").devices}
    assert list(devices) == ["imu", "imu2", "bow"]
    assert devices["imu2"].options.node == 8  # type: ignore[union-attr]
    assert (setup.steps().undo(), (gateway.root / "etc/imud.yaml").read_text()) == (0, mine)


def test_a_running_daemon_is_left_running_and_reads_the_new_file(gateway: LivingMachine, setup: Setup) -> None:
    gateway.write("/etc/imud.yaml", "devices:\n  bow: {uart: {port: /dev/ttyUSB0}}\n")
    gateway.hold("ttyUSB0", "imud run")
    gateway.units["imud.service"] = ["enabled", "active"]
    gateway.usb_port("ttyUSB1", "usb-B", serial="B")
    setup.attachments.hears("/dev/serial/by-id/usb-B", "imu61x-uart")
    gateway.status = [device("bow"), device("imu")]
    assert (setup.steps().set_up(PORT, ()), setup.attachments.listened) == (0, ["/dev/serial/by-id/usb-B"])
    calls = [line for line in gateway.ran if line.startswith("systemctl")]
    assert (calls, setup.steps().undo()) == (["systemctl try-reload-or-restart imud.service"], 0)
    assert gateway.ran[-1].startswith("udevadm")
    assert gateway.units["imud.service"] == ["enabled", "active"]


def test_modes_of_a_file_its_copy_and_the_journal(gateway: LivingMachine, setup: Setup) -> None:
    """The umask must not change the mode."""
    file, copy = gateway.root / "etc/imud.yaml", gateway.root / "etc/imud.yaml.DATE"
    file.chmod(0o662)
    assert setup.steps().set_up(PORT, ()) == 0
    assert [path.stat().st_mode & 0o777 for path in (file, copy)] == [0o662, 0o662]
    folder = gateway.root / "var/lib/imud-setup"
    assert (folder.stat().st_mode & 0o777, (folder / "journal.json").stat().st_mode & 0o777) == (0o700, 0o600)
    assert "imud.yaml" in (folder / "journal.json").read_text()


def test_an_example_that_the_daemon_uses_is_no_example(gateway: LivingMachine, setup: Setup) -> None:
    gateway.units["imud.service"] = ["enabled", "active"]
    gateway.hold("ttyUSB0", "imud run")
    assert (setup.steps().set_up(PORT, ()), (gateway.root / "etc/imud.yaml").read_text()) == (0, EXAMPLE)
    assert setup.attachments.listened == []


def test_nothing_attached(machine: LivingMachine, setup: Setup) -> None:
    machine.write("/etc/imud.yaml", EXAMPLE)
    before = machine.files()
    assert setup.steps(user="ann").set_up(PORT, ()) == 1
    out = setup.said()
    found = "no serial port and no CAN interface", "imud found no device. Next steps:", "imud doctor"
    assert [words for words in found if words not in out] == []
    assert (machine.files(), machine.ran) == (before, [])


def test_a_user_without_rights_is_told_what_would_be_done(gateway: LivingMachine, setup: Setup) -> None:
    gateway.uid = 1000
    before = gateway.files()
    assert setup.steps().set_up(PORT, ()) == 1
    out = setup.said()
    assert "systemctl enable imud.service" in out
    assert "imud changed nothing: only root can." in out
    assert gateway.files() == before
    with pytest.raises(ImudError, match="only root"):
        setup.steps().undo()


def test_without_systemd_the_configuration_is_written(gateway: LivingMachine, setup: Setup) -> None:
    shutil.rmtree(gateway.root / "run")
    assert setup.steps().set_up(PORT, ()) == 0
    out = setup.said()
    assert "systemd does not run, so imud starts no service" in out
    assert "udev does not run" in out
    assert BY_ID in (gateway.root / "etc/imud.yaml").read_text()
    assert gateway.ran == []


@pytest.mark.parametrize(
    ("prepare", "error", "words"),
    [
        (lambda at: at.write("/etc/imud.yaml", "devices: {bow: {}}\n"), ConfigError, r"imud.yaml:1:\d+: devices.bow"),
        (lambda at: at.write(RULES, "#" * (1 << 20) + "\n"), ImudError, "expected at most 1048576 bytes, got more"),
        (lambda at: (at.root / RULES[1:]).symlink_to("/dev/null"), ImudError, "symbolic link to /dev/null"),
        (lambda at: None, BadArgument, "--yes"),  # questions need a terminal
    ],
    ids=["configuration with a mistake", "large file", "link in place of the rules", "no terminal"],
)
def test_nothing_is_changed_after_a_refusal(
    gateway: LivingMachine, setup: Setup, prepare: Callable[[LivingMachine], object], error: type[ImudError], words: str
) -> None:
    prepare(gateway)
    with pytest.raises(error, match=words):
        setup.steps(ask=error is BadArgument).set_up(PORT, ())
    assert gateway.ran == []


@pytest.mark.parametrize("activity", ["inactive", "active"])
def test_a_service_with_another_configuration_is_unchanged(activity: str, gateway: LivingMachine, setup: Setup) -> None:
    """Such a service would not use the new devices."""
    gateway.started = "/usr/bin/imud run --config /home/ann/bow.yaml"
    gateway.units["imud.service"] = ["disabled", activity]
    gateway.status = []
    assert setup.steps().set_up(PORT, ()) == 0
    out = setup.said()
    assert "imud.service uses another configuration than /etc/imud.yaml, so imud does not change the service" in out
    assert gateway.units["imud.service"] == ["disabled", activity]
    assert not any("systemctl" in line for line in gateway.ran)


def test_a_missing_program_is_told_and_the_rest_is_done(gateway: LivingMachine, setup: Setup) -> None:
    before, no_unit = gateway.files(), "note: systemd does not know imud.service, so imud starts no service"
    for program, note in [
        ("udevadm", "note: cannot run `udevadm control --reload`: No such file or directory"),
        ("usermod", "note: cannot run `usermod --append --groups imud ann`: No such file"),
        ("getent", "All devices send samples."), ("systemctl", no_unit), ("", no_unit),  # systemd without the unit
    ]:  # fmt: skip
        gateway.missing = {program}
        if not program:
            gateway.units.clear()
        assert setup.steps(user="ann").set_up(PORT, ()) == 0
        assert note in setup.said(), program
        assert BY_ID in (gateway.root / "etc/imud.yaml").read_text()
        gateway.missing = set() if program == "getent" else {program}
        assert setup.steps().undo() == 0
        assert gateway.files() == before, program


def test_a_masked_service_and_a_missing_group_are_told(gateway: LivingMachine, setup: Setup) -> None:
    gateway.write("/etc/group", "root:x:0:\n")
    gateway.units["imud.service"] = ["masked", "inactive"]
    with pytest.raises(ImudError, match=r"imud.service is masked; first run `sudo systemctl unmask imud.service`"):
        setup.steps(user="ann").set_up(PORT, ())
    gateway.units["imud.service"] = ["disabled", "inactive"]
    assert setup.steps(user="ann").set_up(PORT, (), control=True) == 0
    said = setup.said()
    for name in ("imud", "imud-control"):
        assert f"the group {name} does not exist, so imud cannot add ann to it" in said


def test_control_and_wait_have_an_effect(gateway: LivingMachine, setup: Setup) -> None:
    gateway.status = [device("imu", state=DeviceState.SEARCHING, problem="nothing is heard")]
    assert setup.steps(user="ann").set_up(PORT, (), control=True, wait_s=7.0) == 1
    assert ((gateway.root / "etc/group").read_text().count(":ann\n"), setup.slept) == (2, [0.5] * 14)
    said = setup.said()
    assert "imu: nothing is heard" in said
    assert "the next step with `sudo imud doctor`" in said


def test_undo_leaves_what_is_already_as_before(gateway: LivingMachine, setup: Setup) -> None:
    assert setup.steps(user="ann").set_up(PORT, ()) == 0
    gateway.units["imud.service"] = ["disabled", "inactive"]
    gateway.ran.clear()
    assert setup.steps().undo() == 0
    changing = ("systemctl stop", "systemctl disable", "systemctl mask")
    assert not [line for line in gateway.ran if line.startswith(changing)]


# --- questions --------------------------------------------------------------------------------------------------------


def test_questions_name_and_leave_out(gateway: LivingMachine, setup: Setup, answers: dict[str, str]) -> None:
    gateway.usb_port("ttyUSB1", "usb-B", serial="B")
    setup.attachments.hears("/dev/serial/by-id/usb-B", "imu61x-uart")
    answers |= {"on /dev/ttyUSB0?": "-", "on /dev/ttyUSB1?": "mast", "to change device": "y"}
    gateway.status = [device("mast")]
    assert setup.steps(ask=True, user="ann").set_up(PORT, ()) == 0
    assert [one.name for one in config.load(gateway.root / "etc/imud.yaml").devices] == ["mast"]
    assert "-: expected an unused name" not in setup.said()
    assert (gateway.root / "etc/group").read_text().count(":ann\n") == 2
    with mock.patch("builtins.input", Mock(return_value="n")) as asked:
        setup.steps(ask=True, user="ann").set_up(PORT, ())
        assert "Allow ann" not in str(asked.call_args_list), "a member is not asked again"


def test_a_proposed_name_is_a_new_one(gateway: LivingMachine, setup: Setup, answers: dict[str, str]) -> None:
    gateway.usb_port("ttyUSB1", "usb-B", serial="B")
    setup.attachments.hears("/dev/serial/by-id/usb-B", "imu61x-uart")
    answers["on /dev/ttyUSB0?"] = "imu2"
    gateway.status = [device("imu2"), device("imu")]
    assert setup.steps(ask=True).set_up(PORT, ()) == 0
    assert [one.name for one in config.load(gateway.root / "etc/imud.yaml").devices] == ["imu2", "imu"]


def test_a_device_without_a_name_is_left_out(gateway: LivingMachine, setup: Setup, answers: dict[str, str]) -> None:
    answers["on /dev/ttyUSB0?"] = "My Sensor"
    assert setup.steps(ask=True).set_up(PORT, ()) == 1
    said = setup.said()
    assert "imud does not add /dev/ttyUSB0 after 10 invalid answers" in said
    assert said.count("My Sensor: expected an unused name") == 10


def test_an_invalid_and_a_valid_bit_rate(gateway: LivingMachine, setup: Setup, answers: dict[str, str]) -> None:
    gateway.can("can0")
    answers |= {"can0 is down": "y", "Bit rate": "500k"}
    with pytest.raises(ImudError, match="expected a bit rate for can0"):
        setup.steps(ask=True).set_up(PORT, ())
    assert setup.said().count("500k: expected a whole number from 1 to 1000000") == 10
    for word in ("0", "1000001"):
        answers["Bit rate"] = word
        with pytest.raises(ImudError, match="got 10 invalid answers"):
            setup.steps(ask=True).set_up(PORT, ())
    gateway.units["systemd-networkd.service"] = ["enabled", "active"]
    for word, rate in (("1", 1), ("1000000", 1_000_000), ("", 500_000)):
        answers["Bit rate"] = word
        setup.slept.clear()
        setup.steps(ask=True).set_up(PORT, ())
        text = (gateway.root / "etc/systemd/network/80-imud-can0.network").read_text()
        assert f"[CAN]\nBitRate={rate}\n" in text
        assert setup.slept.count(0.2) in (25, 26), "imud waits 5 s for the interface, which stays down here"
    answers |= {"Bit rate": "250000", "Make these changes?": "n"}
    setup.attachments.listened.clear()
    assert (setup.steps(ask=True).set_up(PORT, ()), setup.attachments.listened) == (1, [])


def test_the_default_keeps_consoles_and_can(gateway: LivingMachine, setup: Setup, answers: dict[str, str]) -> None:
    asked = Mock(return_value="")
    gateway.uart("ttyAMA0", console=True)
    gateway.can("can0")
    gateway.write("/etc/group", "root:x:0:\nimud:x:990:\nimud-control:x:991:bob\n")
    with mock.patch("builtins.input", asked):
        setup.steps(ask=True).set_up(PORT, ())
    assert asked.call_args_list == [
        call("/dev/ttyAMA0 has a console. Is a device connected, so that imud can remove the console? [y/N] "),
        call("The CAN interface can0 is down. Bring it up now and at every boot? [y/N] "),
        call("Name of hipnuc-uart on /dev/ttyUSB0? (`-`: do not add) [imu] "), call("Make these changes? [Y/n] "),
    ]  # fmt: skip
    assert answers == {}
    assert "can0" not in str(gateway.ran)


def test_a_no_changes_nothing(gateway: LivingMachine, setup: Setup, answers: dict[str, str]) -> None:
    before = gateway.files()
    answers["Make these changes?"] = "n"
    assert (setup.steps(ask=True).set_up(PORT, ()), gateway.files(), gateway.ran) == (1, before, [])
    setup.steps().set_up(PORT, ())
    after = gateway.files()
    answers["Undo these changes?"] = "n"
    assert (setup.steps(ask=True).undo(), setup.steps(dry_run=True).undo()) == (1, 0)
    assert "Undo, newest change first:" in setup.said()
    assert gateway.files() == after


# --- ports in use, consoles, CAN --------------------------------------------------------------------------------------


def test_ports_of_others_and_consoles_are_not_opened(gateway: LivingMachine, setup: Setup) -> None:
    gateway.hold("ttyUSB0", "gpsd")
    gateway.uart("ttyAMA0", console=True)
    assert (setup.steps().set_up(PORT, ()), setup.attachments.listened) == (1, [])
    out = setup.said()
    assert "in use by gpsd (pid 10)" in out
    assert "the port is a console of the kernel" in out


def test_a_console_is_taken_off_the_port_that_is_named(gateway: LivingMachine, setup: Setup) -> None:
    gateway.uart("ttyAMA0", console=True)
    own = mock.patch("imud.cli.setup.steps.own_terminal", Mock(return_value="/dev/ttyAMA0"))
    with own, pytest.raises(ImudError, match="on the terminal /dev/ttyAMA0; use another"):
        setup.steps().set_up(Wanted(("/dev/ttyAMA0",)), ())
    (gateway.root / "dev/serial0").symlink_to("ttyAMA0")
    line = "console=serial0,115200 console=tty1 root=PARTUUID=1-02 rootwait\n"
    gateway.write("/boot/firmware/cmdline.txt", line)
    setup.attachments.hears("/dev/ttyAMA0", "imu61x-uart")
    before = gateway.files()
    gateway.status = [device("imu")]
    assert setup.steps().set_up(Wanted(("/dev/serial0",)), ()) == 0
    assert (gateway.root / "boot/firmware/cmdline.txt").read_text() == line.removeprefix("console=serial0,115200 ")
    assert gateway.units["serial-getty@ttyAMA0.service"] == ["masked", "inactive"]
    assert setup.attachments.listened == ["/dev/ttyAMA0"]
    assert "reboot the host" in setup.said()
    assert (setup.steps().undo(), gateway.files()) == (0, before)
    assert gateway.units["serial-getty@ttyAMA0.service"] == ["disabled", "active"]


def test_a_can_interface_is_brought_up_before_the_search(gateway: LivingMachine, setup: Setup) -> None:
    gateway.can("can0")
    gateway.units["systemd-networkd.service"] = ["enabled", "active"]
    setup.attachments.hears("can0", "imu61x-can", "base_id 101", 250000)
    before = gateway.files()
    run = gateway.run

    def brings_up(words: list[str]) -> object:
        if tuple(words[:2]) == ("networkctl", "reconfigure"):
            gateway.can("can0", up=True)
        return run(words)

    gateway.run = brings_up  # type: ignore[method-assign,assignment]
    gateway.status = [device("imu"), device("imu2")]
    assert setup.steps().set_up(PORT, [("can0", 250000)]) == 0
    assert "[CAN]\nBitRate=250000\n" in (gateway.root / "etc/systemd/network/80-imud-can0.network").read_text()
    assert "can0" in setup.attachments.listened
    setup.attachments.listened.clear()
    setup.steps(dry_run=True).set_up(Wanted(("/dev/ttyUSB0",)), [("can0", 250000)])
    assert setup.attachments.listened == ["can0"], "beside the ports that are named, which the daemon has"
    assert (setup.steps().undo(), gateway.files()) == (0, before)
    assert "ip link set can0 down" in gateway.ran


# --- broken on purpose ------------------------------------------------------------------------------------------------


class Killed(BaseException):
    """Simulated end of the process."""


@pytest.mark.parametrize("step", range(14))
def test_killed_at_any_step_all_is_undone(gateway: LivingMachine, setup: Setup, step: int) -> None:
    """The process ends before or after each write of a file or of the journal, and each command."""
    before, fuse = gateway.files(), Mock(side_effect=[*[None] * step, *[Killed] * 14])
    write, run = changes.write, gateway.run

    def writes(*args: object) -> None:
        fuse()
        write(*args)  # type: ignore[arg-type]
        fuse()

    def runs(words: list[str]) -> object:
        if words[0] != "usermod" and tuple(words[:2]) not in (("systemctl", "enable"), ("systemctl", "restart")):
            return run(words)
        fuse()
        output = run(words)
        fuse()
        return output

    with mock.patch.object(changes, "write", writes), mock.patch.object(gateway, "run", runs), suppress(Killed):
        assert setup.steps(user="ann").set_up(PORT, ()) == 0
    assert (fuse.call_count <= step, setup.steps().undo(), gateway.files()) == (step >= 12, 0, before)
    assert gateway.units["imud.service"] == ["disabled", "inactive"]


def test_a_full_disk_stops_before_the_first_change_without_a_record(gateway: LivingMachine, setup: Setup) -> None:
    before, names = gateway.files(), list[str]()

    def full(path: Path, content: bytes, **more: object) -> None:
        names.append(path.name)
        if names.count("journal.json") == 5:
            raise OSError(28, "No space left on device", str(path))
        replace_file(path, content, **more)  # type: ignore[arg-type]

    with mock.patch.object(journal, "replace_file", full), pytest.raises(OSError, match="No space"):
        setup.steps().set_up(PORT, ())
    assert "imud made 2 of 5 changes; undo: `sudo imud setup --undo`" in setup.said()
    assert ((gateway.root / "etc/imud.yaml").read_text(), setup.steps().undo()) == (EXAMPLE, 0)
    assert gateway.files() == before


def test_a_file_changed_since_is_left_and_named_once(gateway: LivingMachine, setup: Setup) -> None:
    setup.steps().set_up(PORT, ())
    mine = (gateway.root / "etc/imud.yaml").read_text() + "# mine\n"
    gateway.write("/etc/imud.yaml", mine)
    assert setup.steps().undo() == 1
    out = setup.said()
    assert "not undone: /etc/imud.yaml was changed after `imud setup` wrote it, so imud does not change it" in out
    assert (gateway.root / "etc/imud.yaml").read_text() == mine
    assert gateway.units["imud.service"] == ["disabled", "inactive"]
    assert not (gateway.root / "etc/udev/rules.d/61-imud-setup.rules").exists()
    gateway.write("/etc/imud.yaml", mine.removesuffix("# mine\n"))  # the user undoes the edit
    assert (setup.steps().undo(), (gateway.root / "etc/imud.yaml").read_text()) == (0, EXAMPLE)
    record = journal.begun(gateway.surroundings(), journal.FileChange("a test", "/etc/imud.yaml", b"a: 1\n"))
    gateway.write("/etc/imud.yaml", "mine")
    with pytest.raises(journal.ChangeRefused, match=r"changed /etc/imud\.yaml in the meantime; run `imud setup` again"):
        journal.make(gateway.surroundings(), record)
    gateway.write("/etc/imud.yaml", EXAMPLE)
    setup.steps().set_up(PORT, ())
    gateway.usb_port("ttyUSB1", "usb-B", serial="B")
    setup.attachments.hears("/dev/serial/by-id/usb-B", "imu61x-uart")
    setup.steps(date="LATER").set_up(PORT, (), wait_s=1)
    gateway.write("/etc/imud.yaml", "devices: {}\n")
    setup.said()
    assert (setup.steps().undo(), setup.said().count("/etc/imud.yaml was changed after")) == (1, 1)


def test_the_former_content_of_a_file_that_is_left_is_kept(gateway: LivingMachine, setup: Setup) -> None:
    before = gateway.files()
    file, copy = gateway.root / "etc/imud.yaml", gateway.root / "etc/imud.yaml.DATE"
    for spoil in (file.unlink, lambda: file.write_text("devices: {}\n")):
        setup.steps().set_up(PORT, ())
        spoil()
        assert setup.steps().undo() == 1
        assert "imud keeps /etc/imud.yaml.DATE, the backup of /etc/imud.yaml" in setup.said()
        shutil.copy2(copy, file)  # the user solves the problem
        assert (setup.steps().undo(), gateway.files()) == (0, before)


def test_a_link_in_place_of_the_configuration_is_followed(gateway: LivingMachine, setup: Setup) -> None:
    gateway.write("/etc/kept/imud.yaml", EXAMPLE)
    (gateway.root / "etc/imud.yaml").unlink()
    (gateway.root / "etc/imud.yaml").symlink_to("kept/imud.yaml")
    assert setup.steps().set_up(PORT, ()) == 0
    assert (gateway.root / "etc/imud.yaml").is_symlink()
    assert BY_ID in (gateway.root / "etc/kept/imud.yaml").read_text()
    assert (setup.steps().undo(), (gateway.root / "etc/kept/imud.yaml").read_text()) == (0, EXAMPLE)


def test_a_command_that_fails_ends_it_and_what_was_done_is_told(gateway: LivingMachine, setup: Setup) -> None:
    gateway.failing["systemctl restart"] = "Job for imud.service failed."
    with pytest.raises(ImudError, match=r"`systemctl restart imud.service` failed: Job for imud.service failed\."):
        setup.steps().set_up(PORT, ())
    assert "imud made 4 of 5 changes" in setup.said()
    gateway.failing = {"systemctl disable": "no bus"}
    assert setup.steps().undo() == 1
    assert "not undone: `systemctl disable" in setup.said()
    gateway.failing.clear()
    assert (setup.steps().undo(), gateway.units["imud.service"]) == (0, ["disabled", "inactive"])


def test_a_service_that_failed_too_often_is_started(gateway: LivingMachine, setup: Setup) -> None:
    gateway.units["imud.service"] = ["enabled", "failed"]
    assert setup.steps().set_up(PORT, ()) == 0
    assert gateway.ran[-2:] == ["systemctl reset-failed imud.service", "systemctl restart imud.service"]


def test_two_at_a_time_and_an_unreadable_journal_are_refused(gateway: LivingMachine, setup: Setup) -> None:
    with journal.locked(gateway.surroundings()), pytest.raises(ImudError, match="another `imud setup`"):
        setup.steps().set_up(PORT, ())
    assert gateway.ran == []
    gateway.write("/var/lib/imud-setup/journal.json", "[")
    with pytest.raises(ImudError, match="cannot read the journal"):
        setup.steps().undo()


SEARCHING = device("bow", state=DeviceState.SEARCHING, problem="nothing is heard")


def waited(look: Callable[[float], list[DeviceStatus]], names: Sequence[str]) -> tuple[list[DeviceStatus], float]:
    now = [0.0]

    def sleep(s: float) -> None:
        now[0] += s

    return wait_for_samples(lambda: look(now[0]), names, 30.0, lambda: now[0], sleep), now[0]


def test_waiting_ends_four_seconds_after_all_run_or_at_the_limit_and_reasons_and_tables_of_80_columns() -> None:
    found, end_s = waited(lambda now: [device("bow"), device("other")] if now >= 3 else [SEARCHING], ["bow"])
    assert ([one.name for one in found], end_s) == (["bow"], 7.0)
    found, end_s = waited(lambda now: [SEARCHING if 2 <= now < 5 else device("bow")], ["bow"])
    assert (found[0].state, end_s) == ("running", 9.0)
    found, end_s = waited(lambda _: [SEARCHING, device("mast")], ["bow", "mast"])
    assert ([one.state for one in found], end_s) == (["searching", "running"], 30.0)
    with pytest.raises(ImudError, match="does not reply: no daemon"):
        waited(Mock(side_effect=LinkMissing("no daemon")), ["bow"])
    assert reasons([device("bow")], ["bow"]) == []
    assert reasons([SEARCHING, device("mast")], ["bow", "mast", "keel"]) == [
        "bow: nothing is heard", "keel: the daemon does not use this device: check `systemctl status imud`",
    ]  # fmt: skip
    table = samples_table([device("bow"), device("mast", state=DeviceState.MISSING, identity={})])
    head, bow, mast = table.splitlines()
    assert head.split() == ["DEVICE", "STATE", "RATE", "HZ", "PRODUCT", "CLOCK", "ERROR"]
    assert bow.split() == ["bow", "running", "999.5", "HI13", "0.045", "ms"]
    named = device("n" * 32, identity={"product": "p" * 40}, state=DeviceState.SEARCHING, rate_hz=1000.5)
    assert max(map(len, samples_table([named]).splitlines())) <= 80
    assert mast.split() == ["mast", "missing", "999.5", "-", "-"]
    here = [
        Attached("/dev/serial/by-id/usb-A", "/dev/ttyUSB0", "Adapter " * 9, "hipnuc-uart", "", 115200, {}, "bow"),
        Attached("can0", "can0", "", problem="nothing is heard: " + "is the bus terminated? " * 6),
    ]
    lines = attached_table(here)
    assert max(map(len, lines)) <= 80
    assert lines[1].split()[:3] == ["/dev/ttyUSB0", "hipnuc-uart", "115200"]
    assert lines[1].endswith("bow")
    assert lines[3].startswith("  can0: nothing is heard")
    assert lines[4].startswith("  ")
    node = "/dev/ttyUSB10"
    widest = Attached(node, node, "t" * 90, "hipnuc-nmea2000", "source 253", 1_000_000, {}, "n" * 32)
    assert max(map(len, attached_table([widest]))) == 80


def test_paragraphs_silence_and_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    Conversation(ask=False).say("note: " + "word " * 40 + "\x1b[31m", indent="      ")
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert all(line.startswith("      ") for line in lines[1:])
    assert "\x1b" not in "".join(lines)
    talk = Conversation(ask=False, silent=True)
    talk.say("word")
    talk.show(["line"])
    assert capsys.readouterr().out == ""
    talk = Conversation(ask=False)
    assert talk.agreed("?", default=True)
    assert not talk.agreed("?", default=False)
    assert talk.answer("name?", "imu") == "imu"


def test_answers(answers: dict[str, str]) -> None:
    for word, default, agreed in [
        ("", True, True), ("", False, False), ("Y", False, True), ("yes", False, True), ("n", True, False),
        ("x", True, False),
    ]:  # fmt: skip
        answers["Sure?"] = word
        assert Conversation(ask=True).agreed("Sure?", default=default) is agreed, word


def test_a_question_without_an_answer_ends_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    interrupted = "\nimud setup made no further changes.\n"
    for ended, error, words, out in [
        (EOFError, BadArgument, "end of the input", "\n"), (KeyboardInterrupt, KeyboardInterrupt, "^$", interrupted),
    ]:  # fmt: skip
        monkeypatch.setattr("builtins.input", Mock(side_effect=ended))
        with pytest.raises(error, match=words):
            Conversation(ask=True).agreed("Sure?", default=True)
        assert capsys.readouterr().out == out
