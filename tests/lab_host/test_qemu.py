"""The machine's command line."""

from dataclasses import replace
from pathlib import Path

from tests.lab.host.qemu import Machine


def command(share: str = "/out/run-1") -> list[str]:
    """A machine's argument vector."""
    return Machine(Path("/k/bzImage"), Path(share), Path(share) / "console.log", 512, 3, (7, 8), 9).command()


def test_host_root_is_read_only_and_share_is_not() -> None:
    shares = [argument for argument in command() if argument.startswith("local,")]
    assert [("readonly=on" in share, "mount_tag=hostroot" in share) for share in shares] == [
        (True, True),
        (False, False),
    ]


def test_commas_in_paths_are_doubled() -> None:
    assert any("path=/o,,ut/run-1,mount_tag=lab" in argument for argument in command("/o,ut/run-1"))


def test_processors_are_emulated_and_resets_end_it() -> None:
    arguments = command()
    assert "pc,accel=tcg" in arguments
    assert arguments[arguments.index("-smp") + 1] == "3"
    assert "-no-reboot" in arguments
    assert "panic=-1" in arguments[arguments.index("-append") + 1]


def test_a_steady_clock_is_asked_for() -> None:
    machine = Machine(Path("/k/bzImage"), Path("/out"), Path("/out/console.log"), 512, 1, (7, 8), 9)
    assert "-icount" not in machine.command()
    arguments = replace(machine, steady=True).command()
    assert arguments[arguments.index("-icount") + 1] == "shift=0"
