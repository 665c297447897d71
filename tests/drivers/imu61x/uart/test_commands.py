"""Every command of table 12: golden bytes, and the message that ends its reply.
Steps of scripts: both modes, results by one option, and the requests to a device without replies."""

from collections.abc import Callable
from typing import Any

import pytest

from imud.contracts.script import Reply, ReplyFrame, Request, RequestScript, Silence
from imud.drivers.imu61x.common import crc32
from imud.drivers.imu61x.uart import commands, settings
from imud.drivers.imu61x.uart import commands as c
from imud.drivers.imu61x.uart import commands as contact
from imud.drivers.imu61x.uart.codec import Parameter, pack_acknowledgement, pack_parameters
from imud.drivers.imu61x.uart.commands import Imu61xUartOptions, OutputMode
from imud.model.errors import BadArgument, NoReply, Rejected
from imud.model.sample import Measurement
from imud.sim.imu61x.uart import Imu61xSettings
from tests.support.script_runners import unanswered_ms
from tests.support.simulated_modules import every_variant, imu61x_bench, run_script, variant_bench

STREAM_HEX = "55AA 0300 1800 0000803F" + 20 * "00" + "52D88EE8"
"""Command frame that a device executed."""


@pytest.mark.manual("A 1.6 request", "A 1.6 CMD 1", "A 1.6 CMD 2", "A 1.3 rate and line")
def test_commands_and_the_ends_of_their_replies() -> None:
    assert c.output_mode(c.OutputMode.STREAM).payload == bytes.fromhex(STREAM_HEX)

    assert [command.value for command in c.Command] == [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 14, 15]

    request = c.save()
    for result in (0, 1, 0xFFFF):
        assert request.is_end(ReplyFrame(0x7777, pack_acknowledgement(5, result)))
    assert not request.is_end(ReplyFrame(0x7777, pack_acknowledgement(6, 0)))
    assert not request.is_end("OK")

    s1 = ReplyFrame(0xFF, bytes(22))
    assert c.ask_status().is_end(s1)
    assert not c.ask_status().is_end(ReplyFrame(5, pack_acknowledgement(1, 0)))
    assert c.ask_installation_status().is_end(s1)
    assert c.ask_installation_status().is_end(ReplyFrame(5, pack_acknowledgement(8, 0)))

    request = c.ask_ahrs()
    assert request.is_sample is not None
    assert request.is_sample(Measurement(54, 0, 0))
    assert not request.is_end(ReplyFrame(5, pack_acknowledgement(2, 0)))
    assert request.is_part(ReplyFrame(5, pack_acknowledgement(2, 0)))

    with pytest.raises(BadArgument, match="at most 200 Hz at 115200 baud, got 400 Hz"):
        c.set_rate(400, baud=115200)

    assert c.output_mode(c.OutputMode.COMMAND, baud=921600).baud == 921600
    assert c.output_mode(c.OutputMode.COMMAND).baud == 0


@pytest.mark.parametrize(
    ("request_", "command", "param1", "param3"),
    [
        (c.ask_status(), 1, "00000000", 0), (c.ask_ahrs(), 2, "00000000", 0),
        (c.output_mode(c.OutputMode.STREAM), 3, "0000803F", 0),
        (c.output_mode(c.OutputMode.COMMAND), 3, "0000C842", 0), (c.reset_heading(0), 4, "00000000", 0),
        (c.reset_heading(360), 4, "0000B443", 0), (c.reset_heading(22.5), 4, "0000B441", 0),
        (c.save(), 5, "00000000", 0), (c.read_parameter(Parameter.AHRS_RATE), 6, "00000000", 21),
        (c.start_installation_calibration(), 7, "00000000", 0), (c.ask_installation_status(), 8, "00000000", 0),
        (c.restart(), 9, "00000000", 0), (c.calibrate_gyro(), 10, "00000000", 0),
        (c.set_baud(115200), 14, "0000E147", 3), (c.set_baud(1500000), 14, "001BB749", 3),
        (c.set_rate(400), 14, "0000C843", 21), (c.set_bus_mode(c.BusMode.UART_ONLY), 14, "00000000", 27),
        (c.set_bus_mode(c.BusMode.BY_PIN), 14, "00004040", 27), (c.set_i2c_address(0x18), 14, "0000C041", 30),
        (c.set_i2c_address(0x1B), 14, "0000D841", 30), (c.set_filter(0xB, 0xB), 14, "00003B43", 31),
        (c.set_filter(0, 4), 14, "00008040", 31), (c.factory_reset(), 15, "00000000", 0),
    ],
)  # fmt: skip
@pytest.mark.manual("A 1.6 request")
def test_bytes(request_: Request, command: int, param1: str, param3: int) -> None:
    body = (
        b"\x55\xaa" + command.to_bytes(2, "little") + b"\x18\x00"
        + bytes.fromhex(param1) + bytes(4) + param3.to_bytes(4, "little") + bytes(12)
    )  # fmt: skip
    assert request_.payload == body + crc32(body).to_bytes(4, "little")
    assert len(request_.payload) == 34


@pytest.mark.parametrize("index", [3, 31])
@pytest.mark.manual("A 1.6 CMD 6")
def test_every_parameter_can_be_read(index: int) -> None:
    request = c.read_parameter(Parameter(index))
    assert request.is_end(ReplyFrame(6, pack_parameters(1.5, index)))
    assert not request.is_end(ReplyFrame(6, pack_parameters(1.5, index + 1)))
    acknowledged = ReplyFrame(99, pack_acknowledgement(6, 1))
    assert not request.is_end(acknowledged)
    assert request.is_part(acknowledged)


@pytest.mark.manual("A 1.3 rate and line")
def test_plain_numbers_are_not_enum_members_and_rates_fit() -> None:
    # a type checker rejects it; without a type checker no frame is made either
    makers: list[Callable[[Any], Request]] = [c.set_bus_mode, c.output_mode, c.read_parameter]
    for make, value in zip(makers, (1, 1, 21), strict=True):
        with pytest.raises(AttributeError):
            make(value)
    for baud, most_hz in ((115200, 200), (230400, 400), (460800, 400), (1500000, 400)):
        assert c.max_rate_hz(baud) == most_hz
        c.set_rate(most_hz, baud=baud)


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
