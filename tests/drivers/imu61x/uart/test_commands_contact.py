"""Steps of scripts: both modes, results by one option, and the requests to a device without replies."""

import pytest

from imud.contracts.script import Reply, RequestScript, Silence
from imud.drivers.imu61x.uart import commands, settings
from imud.drivers.imu61x.uart import commands as contact
from imud.drivers.imu61x.uart.codec import Parameter
from imud.drivers.imu61x.uart.commands import Imu61xUartOptions, OutputMode
from imud.model.errors import NoReply, Rejected
from imud.sim.imu61x.uart import Imu61xSettings
from tests.support.script_runners import unanswered_ms
from tests.support.simulated_modules import every_variant, imu61x_bench, run_script, variant_bench


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
    ("script", "timeouts_ms"),
    [
        (contact.settled(), [300] * 10),
        (_baud(), [300] * 5),
        (contact.resume_streaming(), [300] * 5),
        (contact.in_command_mode(_baud), [300] * 7),
        (settings.save(), [300] * 11),
        (settings.change_baud(921600, 115200), [300] * 11),
        (settings.start_streaming(), [300] * 5 + [3000]),
        (contact.acknowledged(commands.calibrate_gyro(), 0), [10_000] + [300] * 10),
        (contact.acknowledged(commands.start_installation_calibration(), 0), [10_000] + [300] * 10),
        (contact.acknowledged(commands.save(), 0), [5000] + [300] * 10),
        (contact.acknowledged(commands.factory_reset(), 0), [5000] + [300] * 10),
    ],
)
def test_requests_to_a_device_without_replies(script: RequestScript[object], timeouts_ms: list[float]) -> None:
    assert [*unanswered_ms(script)] == timeouts_ms


def test_a_device_without_replies_raises_no_reply() -> None:
    for script in (contact.settled(), contact.acknowledged(commands.reset_heading(0), 0)):
        with pytest.raises(NoReply, match="status: expected a reply, got none"):
            run_script(script, lambda _request: Silence(()))
