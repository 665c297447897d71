"""Steps of scripts: both modes, results by one option, and the requests to a device without replies."""

import pytest

from imud.contracts.script import Reply, RequestScript, Silence
from imud.drivers.imu61x.uart import commands
from imud.drivers.imu61x.uart import commands as contact
from imud.drivers.imu61x.uart.codec import Parameter
from imud.drivers.imu61x.uart.commands import Imu61xUartOptions, OutputMode
from imud.model.errors import NoReply, Rejected
from imud.sim.imu61x.uart import Imu61xSettings
from tests.support.simulated_modules import every_variant, imu61x_bench, variant_bench


def _baud() -> RequestScript[float]:
    return contact.read(Parameter.BAUD)


@every_variant
def test_command_mode_is_restored(variant: str) -> None:
    for mode in OutputMode:
        far = variant_bench(variant, Imu61xSettings(mode=mode))
        assert far.run(contact.in_command_mode(_baud)) == 115200
        far.samples(800)
        assert bool(far.samples(1000)) is (mode is OutputMode.STREAM)


def test_every_request_in_command_mode_can_be_undone() -> None:
    """A script that is cancelled after CMD 3 leaves the bytes that make the device stream."""
    far = imu61x_bench(answers_while_streaming=False)
    script = contact.in_command_mode(_baud)
    request = next(script)
    undone = []
    with pytest.raises(StopIteration):  # noqa: PT012  # driven by hand
        while True:
            undone.append((request.name, request.undo == contact.STREAM))
            request = script.send(far.ask(request))
    assert undone[0] == ("status", False)
    assert [undo for name, undo in undone[1:] if name != "output mode STREAM"] == [True] * 3


def test_result_is_judged_by_the_option() -> None:
    far = imu61x_bench(Imu61xSettings(mode=OutputMode.COMMAND), result_done=1)
    assert far.run(contact.ordered(commands.reset_heading(0), 1)) is True
    with pytest.raises(Rejected, match="heading reset: expected result 0"):
        far.run(contact.ordered(commands.reset_heading(0), 0))
    far = imu61x_bench(Imu61xSettings(mode=OutputMode.COMMAND), acknowledges=False)
    assert far.run(contact.ordered(commands.reset_heading(0), 0)) is False
    assert Imu61xUartOptions() == Imu61xUartOptions(result_done=0)
    assert contact.result_of(Silence(())) is None
    assert contact.result_of(Reply(("text",))) is None


@pytest.mark.parametrize(
    ("script", "requests", "unheard"),
    [
        (contact.settled(), 10, "status"),
        (_baud(), 5, "read parameter BAUD"),
        (contact.resume_streaming(), 5, ""),
        (contact.in_command_mode(_baud), 7, "status"),
        (contact.acknowledged(commands.reset_heading(0), 0), 11, "status"),
    ],
)
def test_a_device_without_replies_raises_no_reply(script: RequestScript[object], requests: int, unheard: str) -> None:
    asked = [next(script)]
    with pytest.raises((NoReply, StopIteration)) as caught:  # noqa: PT012  # driven by hand
        while True:
            asked.append(script.send(Silence(())))
    assert len(asked) == requests
    assert str(caught.value).startswith(f"{unheard}: expected a reply, got none" if unheard else "False")
    assert {one.timeout_ns for one in asked} == {300_000_000}
