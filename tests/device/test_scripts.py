"""Request scripts on a shared link: one at a time, in order, with late and missing replies."""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest

from imud.contracts.driver import StreamDriver
from imud.contracts.script import (
    Outcome,
    Rejection,
    Reply,
    ReplyFrame,
    Request,
    RequestScript,
    Silence,
    never,
    pause,
    with_undo,
)
from imud.device.scripts import REPLY_MESSAGES_MAX, RequestPort, ScriptRunner
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.canopen import cia301
from imud.drivers.hipnuc.j1939.codec import J1939Node
from imud.drivers.hipnuc.j1939.commands import LAYOUT, READ, WRITE, exchange
from imud.drivers.hipnuc.uart import commands
from imud.drivers.imu61x.uart import commands as imu61x
from imud.drivers.imu61x.uart.codec import PARAMETER_FRAME, Parameter, pack_parameters
from imud.host.clock import HostClock
from imud.model.errors import CommandError, LinkMissing, NoReply
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from tests.support.event_loops import VirtualClock, in_loop, run_virtually
from tests.support.script_runners import ListPort, of_fast_device, of_text, offline_runner


def request(name: str, timeout_ns: int = 10**10, *, silent: bool = False) -> Request:
    return Request(
        payload=name.encode() + b"\r\n", name=name, is_end=of_text(lambda text: text == "OK"),
        is_rejection=of_text(lambda text: text.startswith("ERR")), is_part=of_text(lambda text: text.startswith(name)),
        timeout_ns=timeout_ns, silent=silent,
    )  # fmt: skip


def ask(*requests: Request) -> RequestScript[list[Outcome]]:
    outcomes = []
    for one in requests:
        outcomes.append((yield one))
    return outcomes


class CallingPort(RequestPort):
    """A link that calls a function for each request, and notes what a script changes."""

    def __init__(self, write: Callable[[bytes], None]) -> None:
        self.changes: list[object] = []
        self._write = write

    def write(self, data: bytes) -> None:
        self.changes.append(data)
        self._write(data)

    def change_rate(self, request: Request) -> None:
        self.changes.append(request.baud)

    def follow(self, request: Request) -> None:
        self.changes.append(request.settings)

    def listen(self, request: Request, filters: Sequence[Any]) -> None:
        self.changes.append(filters)


def made() -> tuple[ScriptRunner, list[bytes]]:
    port = ListPort()
    return of_fast_device(ScriptRunner(port, Ledger(), HostClock())), port.written


def runner_of(write: Callable[[bytes], None], clock: VirtualClock | None = None) -> ScriptRunner:
    return ScriptRunner(CallingPort(write), Ledger(), clock.host if clock else HostClock())


@in_loop
async def test_requests_and_scripts_run_one_at_a_time() -> None:
    runner, written = made()
    task = asyncio.create_task(runner.run(ask(request("A"), request("B"))))
    await asyncio.sleep(0)
    assert written == [b"A\r\n"]
    runner.on_message("A=1", 0)
    runner.on_message("OK", 0)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert written == [b"A\r\n", b"B\r\n"]
    runner.on_message("ERR", 0)
    outcomes = await task
    assert (outcomes[0], outcomes[1].lines) == (Reply(("A=1", "OK")), ("ERR",))
    runner, written = made()
    first = asyncio.create_task(runner.run(ask(request("A"))))
    second = asyncio.create_task(runner.run(ask(request("B"))))
    for _ in range(5):
        await asyncio.sleep(0)
    assert written == [b"A\r\n"]
    runner.on_message("OK", 0)
    await first
    for _ in range(5):
        await asyncio.sleep(0)
    assert written == [b"A\r\n", b"B\r\n"]
    runner.on_message("OK", 0)
    await second


@in_loop
async def test_a_timed_out_cancelled_or_failed_script_allows_the_next_script() -> None:
    gone = True

    def write(data: bytes) -> None:
        if gone:
            raise LinkMissing("pulled out")

    runner = runner_of(write)
    with pytest.raises(LinkMissing):
        await runner.run(ask(request("A")))
    gone = False
    assert await runner.run(ask(request("B", silent=True))) == [Reply(())]
    runner, _ = made()
    task = asyncio.create_task(runner.run(ask(request("A"))))
    await asyncio.sleep(0)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert await runner.run(ask(request("B", silent=True))) == [Reply(())]
    ledger = Ledger()
    runner = offline_runner(ledger)
    assert await runner.run(ask(request("A", timeout_ns=1))) == [Silence(())]
    runner.on_message("A=1", 0)
    runner.on_message("OK", 0)
    assert (ledger.replies_late, ledger.replies_unsolicited) == (1, 0)
    runner.on_message("OK", 0)
    assert ledger.replies_unsolicited == 1


def test_a_device_without_reply_raises_no_reply() -> None:
    clock, driver = VirtualClock(), DRIVERS["hipnuc-uart"]
    assert isinstance(driver, StreamDriver)
    script = driver.identify()

    async def body() -> None:
        with pytest.raises(NoReply, match="LOG VERSION"):
            await ScriptRunner(ListPort(), Ledger(), HostClock(clock.now_ns)).run(script)

    run_virtually(clock, body())


@in_loop
async def test_a_script_receives_its_reply_frame_or_measurement() -> None:
    runner, _ = made()
    wanted = ReplyFrame(5, b"x")
    asking = replace(request("A"), is_end=lambda message: message == wanted)
    task = asyncio.create_task(runner.run(ask(asking)))
    await asyncio.sleep(0)
    runner.on_message(wanted, 0)
    assert await task == [Reply((wanted,))]
    runner, _ = made()
    assert not runner.wants_samples
    task = asyncio.create_task(runner.run(ask(replace(request("A"), is_sample=lambda sample: True))))
    await asyncio.sleep(0)
    assert runner.wants_samples
    runner.on_sample(Measurement(54, 0, 3))
    runner.on_sample(Measurement(54, 0, 4))
    assert await task == [Reply((), Measurement(54, 0, 3))]
    assert not runner.wants_samples
    runner, written = made()
    assert await runner.run(ask(pause(1_000_000))) == [Silence(())]
    assert written == []


@pytest.mark.parametrize("is_there", [True, False])
@in_loop
async def test_a_cancelled_script_is_undone_if_the_link_exists(is_there: bool) -> None:
    written: list[bytes] = []

    def write(data: bytes) -> None:
        if not is_there and written:
            raise LinkMissing("gone")
        written.append(data)

    runner = runner_of(write)
    task = asyncio.create_task(runner.run(with_undo(ask(request("A"), request("B")), b"UNDO")))
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert written == [b"A\r\n", *[b"UNDO"] * is_there]


@in_loop
async def test_a_finished_script_is_not_undone() -> None:
    """The script returns or raises: it has left the device in a defined state."""

    def failing() -> RequestScript[None]:
        yield request("A", timeout_ns=1)
        raise NoReply("no")

    runner, written = made()
    assert await runner.run(with_undo(ask(request("A", timeout_ns=1)), b"UNDO")) == [Silence(())]
    with pytest.raises(NoReply):
        await runner.run(with_undo(failing(), b"UNDO"))
    assert written == [b"A\r\n"] * 2


@pytest.mark.parametrize(
    ("change", "words"),
    [({"baud": 9600}, "9600 baud"), ({"settings": "node 9"}, "expected a bus"), ({"also": ["id"]}, "a CAN bus")],
    ids=["rate", "number", "other frames"],
)
@in_loop
async def test_a_request_can_change_rate_number_or_filters(change: dict[str, Any], words: str) -> None:
    """The change precedes the request. A link without the property is an error."""
    port = CallingPort(lambda _data: None)
    runner = ScriptRunner(port, Ledger(), HostClock())
    silent = request("B", silent=True)
    assert await runner.run(ask(request("A", silent=True), replace(silent, **change))) == [Reply(())] * 2
    after = [()] if "also" in change else []
    assert port.changes == [b"A\r\n", *change.values(), b"B\r\n", *after]
    runner, written = made()
    with pytest.raises(CommandError, match=words):
        await runner.run(ask(replace(silent, **change)))
    assert written == []


# --- slow devices -----------------------------------------------------------------------------------------------------

MS = 1_000_000


def on_slow_device(delays_ms: Sequence[float | None], *requests: Request) -> tuple[list[str], list[int]]:
    """Send requests to a device that replies OK in order, after each delay or not at all (None). Later delays are 1 ms.

    The device replies to a probe, also a late one. Return the end of each outcome, and the times in ms of the requests.
    """
    clock, sent_ms, texts = VirtualClock(), list[int](), list[str]()
    begin_ns, due_ms = clock.now_ns(), [0.0]

    async def body() -> None:
        def write(data: bytes) -> None:
            delay_ms = 1 if data == PROBE.payload else delays_ms[len(sent_ms)]
            now_ms = (clock.now_ns() - begin_ns) // MS
            if data == PROBE.payload:
                text = "probe"
            else:
                sent_ms.append(now_ms)
                text = f"{len(sent_ms)} OK"
            if delay_ms is not None:
                due_ms.append(max(due_ms[-1], now_ms + delay_ms))
                later((due_ms[-1] - now_ms) / 1000, lambda: runner.on_message(text, clock.now_ns()))

        later = asyncio.get_running_loop().call_later
        runner = runner_of(write, clock)
        texts.extend("".join(one.lines) for one in await runner.run(ask(*requests)))

    run_virtually(clock, body())
    return texts, sent_ms


PROBE = Request(b"?", "probe", of_text(lambda text: text == "probe"), never, never, kind="probe", repeatable=True)


def ok(name: str, *, kind: str = "OK", repeatable: bool = False) -> Request:
    numbered = of_text(lambda text: text.endswith("OK"))
    return Request(name.encode(), name, numbered, never, numbered, kind=kind, repeatable=repeatable, probe=PROBE)


def test_the_timeout_follows_the_slowest_reply_also_of_a_further_reply() -> None:
    """Twice the slowest reply, at most 3 s, and at least the own timeout of the request."""
    texts, sent_ms = on_slow_device([400, 750, 1400, 2700, None, 0], *map(ok, "ABCDE"), ok("F", kind="F"))
    assert texts == ["1 OK", "2 OK", "3 OK", "4 OK", "", "6 OK"]
    assert sent_ms == [0, 400, 1150, 2550, 5250, 8250]
    assert on_slow_device([100, None, 0], ok("A"), ok("B"), ok("C", kind="C"))[1] == [0, 100, 600]
    further = replace(ok("A"), payload=b"", name="A, further reply")
    texts, sent_ms = on_slow_device([400, 700], ok("A"), further, ok("B"))
    # no reply within twice 400 ms, then the reply to a probe
    assert (texts, sent_ms) == (["1 OK", "", "2 OK"], [0, 400 + 800 + 1])


@pytest.mark.parametrize(
    ("delay_ms", "outcomes"),
    [(450, ["1 OK"]), (700, ["", "1 OK"]), (1300, ["", "1 OK"]), (2900, ["", "", "1 OK"]), (None, [""] * 5)],
)
def test_the_first_contact_is_patient(delay_ms: int | None, outcomes: list[str]) -> None:
    """Each timeout doubles the next timeout up to 3 s. The reply to the first read answers an equal later read."""
    read = ok("read", kind="read", repeatable=True)
    texts, sent_ms = on_slow_device([delay_ms] * 5, *[read] * len(outcomes))
    assert (texts, sent_ms) == (outcomes, [0, 500, 1500, 3500, 6500][: len(outcomes)])


@pytest.mark.parametrize(
    ("late_ms", "next_ms", "outcomes"),
    [
        (700, 800, ["3 OK", "4 OK"]), (2900, 3000, ["3 OK", "4 OK"]), (3900, 4000, ["3 OK", "4 OK"]),
        (9000, 4100, ["", ""]), (None, 601, ["3 OK", ""]),
    ],
)  # fmt: skip
def test_a_late_reply_never_answers_the_next_similar_request(
    late_ms: int | None, next_ms: int, outcomes: list[str]
) -> None:
    """The reply to a probe shows that the late reply has arrived or is lost. Three probes follow within 3.5 s."""
    texts, sent_ms = on_slow_device([100, late_ms, 50, 900], ok("A"), ok("B"), ok("C"), ok("D"))
    assert (texts, sent_ms[:3]) == (["1 OK", "", *outcomes], [0, 100, next_ms])


def test_a_request_with_another_reply_or_the_same_read_is_sent_immediately() -> None:
    assert on_slow_device([1, None, 1], ok("A"), ok("B"), ok("C", kind="C"))[1] == [0, 1, 501]
    read = ok("read", kind="read", repeatable=True)
    assert on_slow_device([1, None, 1], ok("A"), read, read) == (["1 OK", "", "3 OK"], [0, 1, 501])
    # a write between two equal reads: the late reply has the old value
    texts, sent_ms = on_slow_device([1, 2000, 1, 1], ok("A"), read, ok("write"), read)
    assert (texts, sent_ms) == (["1 OK", "", "", "4 OK"], [0, 1, 501, 2001])


@pytest.mark.parametrize(
    "request_of",
    [
        commands.log_enable,
        lambda: next(cia301.write_object(8, 0x1800, 5, 10, 2)),
        lambda: exchange(J1939Node(128, 85), 0x9E, WRITE, 1, "sign"),
        lambda: imu61x.set_rate(100),
    ],
    ids=["hipnuc-uart", "canopen", "j1939", "imu61x-uart"],
)
def test_a_request_after_an_equal_request_without_reply_follows_a_probe(request_of: Callable[[], Request]) -> None:
    """The reply to the probe has another kind. The simulated device does not reply: three probes."""
    one, clock, port = request_of(), VirtualClock(), ListPort()
    assert one.probe is not None
    assert one.probe.kind != one.kind

    async def body() -> None:
        await ScriptRunner(port, Ledger(), clock.host).run(ask(one, one))

    run_virtually(clock, body())
    assert port.written == [one.payload, *[one.probe.payload] * 3, one.payload]


def sdo(index: int, command: int = 0x43) -> ReplyFrame:
    return ReplyFrame(cia301.SDO_REPLY + 8, bytes([command]) + index.to_bytes(2, "little") + bytes(5))


def register_reply(register: int) -> ReplyFrame:
    return ReplyFrame(sorted(NODE.reply_ids())[0], LAYOUT.pack(register, READ, 0, 7))


def parameter_reply(parameter: Parameter) -> ReplyFrame:
    return ReplyFrame(PARAMETER_FRAME, pack_parameters(1, parameter))


NODE = J1939Node(128, 85)
VERSION, REPORT = ("PNAME=HI14", "UUID=1", "OK"), ("ATT_MODE: 0", "OK")
BAUD, RATE = Parameter.BAUD, Parameter.AHRS_RATE


@pytest.mark.parametrize(
    ("first", "reply", "second", "own"),
    [
        (commands.ask(commands.Query.VERSION), VERSION, commands.log_enable(), ("OK",)),
        (commands.ask(commands.Query.USRCONFIG), REPORT, commands.save_config(), ("ERR",)),
        (commands.ask(commands.Query.USRCONFIG), REPORT, commands.ask(commands.Query.COMCONFIG), ("B: 1", "OK")),
        (next(cia301.read_object(8, 1, 0)), (sdo(1),), next(cia301.read_object(8, 2, 0)), (sdo(2),)),
        (next(cia301.read_object(8, 1, 0)), (sdo(1),), next(cia301.write_object(8, 1, 0, 5, 2)), (sdo(1, 0x60),)),
        (exchange(NODE, 1, READ, 0, ""), (register_reply(1),), exchange(NODE, 2, READ, 0, ""), (register_reply(2),)),
        (imu61x.read_parameter(BAUD), (parameter_reply(BAUD),), imu61x.read_parameter(RATE), (parameter_reply(RATE),)),
    ],
    ids=["uart", "uart save", "uart report", "canopen", "canopen write", "j1939", "imu61x-uart"],
)  # fmt: skip
def test_a_reply_that_a_device_sends_again_is_no_reply_to_the_next_request(
    first: Request, reply: Sequence[Any], second: Request, own: Sequence[Any]
) -> None:
    ledger = Ledger()
    runner = offline_runner(ledger)
    for request, messages in ((first, reply), (second, (*reply, *own))):
        runner.start(request, 0)
        outcomes = [runner.on_message(message, 1) for message in messages]
        assert outcomes[:-1] == [None] * (len(messages) - 1)
        assert isinstance(outcomes[-1], Rejection if own == ("ERR",) and request is second else Reply)
        assert outcomes[-1].messages == messages[-len(own) if request is second else 0 :]
    assert ledger.replies_unsolicited == len(reply)


# --- a runner without an event loop -----------------------------------------------------------------------------------

TIMEOUT_NS = 100


def command(name: str, part: str = "", silent: bool = False) -> Request:
    """Return a request. Its reply is lines that start with `part`, then OK; without `part`, only OK."""
    return Request(
        payload=name.encode(), name=name, is_end=of_text(lambda line: line == "OK"),
        is_rejection=of_text(lambda line: line == "ERR"),
        is_part=of_text(lambda line: bool(part) and line.startswith(part)), timeout_ns=TIMEOUT_NS, silent=silent,
        messages_min=2 if part else 1,
    )  # fmt: skip


@pytest.fixture
def ledger() -> Ledger:
    return Ledger()


@pytest.fixture
def session(ledger: Ledger) -> ScriptRunner:
    return offline_runner(ledger)


def strays(ledger: Ledger) -> tuple[int, int]:
    return (ledger.replies_late, ledger.replies_unsolicited)


def test_replies_refusals_silent_requests_and_silence_at_the_deadline(session: ScriptRunner, ledger: Ledger) -> None:
    assert (session.start(command("ask", "a"), 0), session.deadline_ns) == (b"ask", TIMEOUT_NS)
    assert session.on_message("a=1", 5) is None
    assert session.on_message("OK", 6) == Reply(("a=1", "OK"))
    assert session.deadline_ns is None
    assert session.on_time(1000) is None
    assert strays(ledger) == (0, 0)
    session.start(command("ask", "a"), 0)
    assert session.on_message("ERR", 5) == Rejection(("ERR",))
    assert session.start(command("reboot", silent=True), 0) == b"reboot"
    assert session.deadline_ns is None
    session.start(command("ask", "a"), 0)
    session.on_message("a=1", 5)
    assert session.on_time(TIMEOUT_NS - 1) is None
    assert session.on_time(TIMEOUT_NS) == Silence(("a=1",))
    assert session.on_time(TIMEOUT_NS) is None
    assert session.deadline_ns is None


def test_other_text_is_unsolicited_and_not_part_of_the_reply(session: ScriptRunner, ledger: Ledger) -> None:
    assert session.on_message("boot", 0) is None
    session.start(command("ask", "a"), 0)
    for line in ("noise", "a=1", "noise"):
        assert session.on_message(line, 1) is None
    assert session.on_message("OK", 2) == Reply(("a=1", "OK"))
    assert strays(ledger) == (0, 3)


Step = Request | str | ReplyFrame  # a request to start, or a frame that the device sends


@pytest.mark.parametrize(
    ("first", "steps", "outcomes", "late_and_unsolicited"),
    [
        (["a"], ["a=1", "OK", "OK"], [], (1, 1)),  # no pending request
        ([], ["ERR"], [], (1, 0)),  # a late refusal is also late
        # the reply to the next request is only OK: the lines before an OK identify its request
        (["a"], [command("set"), "a=1", "a=2", "OK", "OK"], [Reply(("OK",))], (1, 0)),
        # the rest of a reply with a timeout in the middle
        (["a", "a=1"], [command("set"), "OK", "ERR"], [Rejection(("ERR",))], (1, 0)),
        # the OK of a request with a timeout arrives after the next request
        ([], [command("ask", "a"), "OK", "a=1", "OK"], [Reply(("a=1", "OK"))], (1, 0)),
        # without a probe, the next matching reply counts for the oldest request
        ([], [command("first"), "OK", "ERR"], [Rejection(("ERR",))], (1, 0)),
        (["a"], [command("ask", "a"), "a=1", "OK"], [Reply(("a=1", "OK"))], (0, 0)),  # the same request again
    ],
)
def test_a_late_reply_does_not_answer_the_next_request(
    session: ScriptRunner, ledger: Ledger, first: list[str], steps: list[Step], outcomes: list[Outcome],
    late_and_unsolicited: tuple[int, int],
) -> None:  # fmt: skip
    """The first request expects `first`, receives some lines in time, and then times out."""
    session.start(command("first", first[0] if first else ""), 0)
    for line in first[1:]:
        session.on_message(line, 5)
    session.on_time(TIMEOUT_NS)
    found, at_ns = [], TIMEOUT_NS
    for step in steps:
        if isinstance(step, Request):
            session.start(step, at_ns)
        elif (outcome := session.on_message(step, at_ns)) is not None:
            found.append(outcome)
    assert (found, strays(ledger)) == (outcomes, late_and_unsolicited)


def test_cancel_forgets_the_request_and_an_endless_reply_is_bounded(session: ScriptRunner, ledger: Ledger) -> None:
    session.start(command("ask", "a"), 0)
    session.on_message("a=1", 1)
    session.cancel()
    assert session.deadline_ns is None
    assert session.on_time(TIMEOUT_NS) is None
    session.on_message("OK", 2)
    assert strays(ledger) == (1, 0)
    session.start(command("ask", "a"), 3)
    session.on_message("a=2", 4)
    assert session.on_message("OK", 4) == Reply(("a=2", "OK"))
    session.start(command("ask", "a"), 0)
    for number in range(REPLY_MESSAGES_MAX + 50):
        session.on_message(f"a={number}", 1)
    silence = session.on_time(TIMEOUT_NS)
    assert silence is not None
    assert len(silence.lines) == REPLY_MESSAGES_MAX


def frame_command(frame_id: int) -> Request:
    is_end = lambda message: isinstance(message, ReplyFrame) and message.frame_id == frame_id  # noqa: E731
    return Request(b"?", f"frame {frame_id}", is_end, never, never, timeout_ns=TIMEOUT_NS)


def test_a_frame_answers_as_a_line_does(session: ScriptRunner, ledger: Ledger) -> None:
    session.start(frame_command(6), 0)
    assert session.on_message("6", 1) is None
    assert session.on_message(ReplyFrame(7, b""), 2) is None
    reply = session.on_message(ReplyFrame(6, b"x"), 3)
    assert reply == Reply((ReplyFrame(6, b"x"),))
    assert (reply.frames, reply.lines) == ((ReplyFrame(6, b"x"),), ())
    assert strays(ledger) == (0, 2)


def test_a_late_frame_is_told_from_the_next_reply(session: ScriptRunner, ledger: Ledger) -> None:
    session.start(frame_command(6), 0)
    session.on_time(TIMEOUT_NS)
    session.start(frame_command(7), TIMEOUT_NS)
    assert session.on_message(ReplyFrame(6, b""), TIMEOUT_NS + 1) is None
    assert strays(ledger) == (1, 0)
    assert session.on_message(ReplyFrame(7, b""), TIMEOUT_NS + 2) == Reply((ReplyFrame(7, b""),))


def test_only_replies_to_ordinary_requests_extend_timeouts_and_only_similar_requests_wait(
    session: ScriptRunner,
) -> None:
    session.start(pause(10**9), 0)
    session.on_time(10**9)  # no late reply follows a pause
    for request_, reply_ns, deadline_ns in (
        (replace(command("slow"), timeout_ns=10**9), 5 * 10**8, 10**9), (command("a"), 80, 100), (command("b"), 0, 160),
    ):  # fmt: skip
        session.start(request_, 0)
        assert session.deadline_ns == deadline_ns
        assert session.on_message("OK", reply_ns) == Reply(("OK",))
    session.start(command("b"), 0)
    session.cancel()
    others = [command("b", silent=True), pause(5), replace(command("b"), baud=115200), command("c")]
    assert [session.is_owed(one) for one in (command("b"), *others)] == [True] + [False] * 4


def test_a_pause_sends_nothing_and_late_replies_stay_late(session: ScriptRunner, ledger: Ledger) -> None:
    session.start(command("ask", "a"), 0)
    session.on_time(TIMEOUT_NS)
    assert session.start(pause(50), TIMEOUT_NS) == b""
    assert session.on_message("a=1", TIMEOUT_NS + 10) is None
    assert session.on_time(TIMEOUT_NS + 49) is None
    assert session.on_time(TIMEOUT_NS + 50) == Silence(())
    session.on_message("OK", TIMEOUT_NS + 60)
    assert strays(ledger) == (1, 0)


# --- measurements -----------------------------------------------------------------------------------------------------


def measured(tick: int) -> Measurement:
    return Measurement(54, 0, tick)


def waiting(ledger: Ledger, tick: int) -> ScriptRunner:
    """Return a runner. Its request waits for the measurement at `tick`."""
    session = offline_runner(ledger)
    session.start(replace(command("once"), is_sample=lambda sample: sample.dev_ticks == tick), 0)
    return session


def test_a_measurement_ends_a_request_that_waits_for_it(ledger: Ledger) -> None:
    session = waiting(ledger, 7)
    assert session.wants_samples
    assert session.on_sample(measured(6)) is None
    assert session.on_sample(measured(7)) == Reply((), measured(7))
    assert not session.wants_samples
    assert session.on_sample(measured(7)) is None
    assert ledger.replies_unsolicited == ledger.replies_late == 0


def test_a_request_without_its_measurement_is_refused_or_silent_and_others_take_none(ledger: Ledger) -> None:
    assert waiting(ledger, 7).on_message("ERR", 1) == Rejection(("ERR",))
    assert waiting(ledger, 7).on_time(TIMEOUT_NS) == Silence(())
    session = offline_runner(ledger)
    session.start(command("save"), 0)
    assert not session.wants_samples
    assert session.on_sample(measured(1)) is None
    assert session.deadline_ns is not None
