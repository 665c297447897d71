"""Requests and replies: valid replies, refusals, silence, late replies, and text that is not a reply."""

from dataclasses import replace
from inspect import GEN_CLOSED, getgeneratorstate

import pytest

from imud.contracts import script as scripts
from imud.contracts.script import Outcome, Rejection, Reply, ReplyFrame, Request, Silence, Transfer, TransferScript
from imud.device.scripts import REPLY_MESSAGES_MAX, ScriptRunner
from imud.model.errors import CommandError, TransferError, Trouble
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from tests.support.script_runners import of_text, offline_runner

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
    assert session.start(command("ask", "a"), 0) == b"ask"
    assert session.deadline_ns == TIMEOUT_NS
    assert session.on_message("a=1", 5) is None
    assert session.on_message("OK", 6) == Reply(("a=1", "OK"))
    assert session.deadline_ns is None
    assert session.on_time(1000) is None
    assert strays(ledger) == (0, 0)
    session.start(command("ask", "a"), 0)
    assert session.on_message("ERR", 5) == Rejection(("ERR",))
    session.start(command("first"), 0)
    with pytest.raises(CommandError, match="second: still waiting for the reply to first"):
        session.start(command("second"), 1)
    assert session.on_message("OK", 2) == Reply(("OK",))
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


Step = Request | str | ReplyFrame
"""A request to start, or a frame that the device sends."""


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
    assert found == outcomes
    assert strays(ledger) == late_and_unsolicited


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
    return Request(b"?", f"frame {frame_id}", is_end, scripts.never, scripts.never, timeout_ns=TIMEOUT_NS)


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


def test_a_pause_sends_nothing_and_late_replies_stay_late(session: ScriptRunner, ledger: Ledger) -> None:
    session.start(command("ask", "a"), 0)
    session.on_time(TIMEOUT_NS)
    assert session.start(scripts.pause(50), TIMEOUT_NS) == b""
    assert session.on_message("a=1", TIMEOUT_NS + 10) is None
    assert session.on_time(TIMEOUT_NS + 49) is None
    assert session.on_time(TIMEOUT_NS + 50) == Silence(())
    session.on_message("OK", TIMEOUT_NS + 60)
    assert strays(ledger) == (1, 0)


def test_a_script_with_undo_passes_requests_on_and_is_closed_with_it() -> None:
    inner = asking()
    outer = scripts.with_undo(inner, b"undo")
    assert next(outer).undo == b"undo"
    outer.close()
    assert getgeneratorstate(inner) == GEN_CLOSED
    outer = scripts.with_undo(asking(), b"undo")
    next(outer)
    with pytest.raises(StopIteration) as end:
        outer.send(Reply(("OK",)))
    assert end.value.value == Reply(("OK",))


def test_a_request_has_half_a_second_for_one_message() -> None:
    request = Request(payload=b"", name="ask", is_end=scripts.never, is_rejection=scripts.never, is_part=scripts.never)
    assert (request.timeout_ns, request.messages_min) == (500_000_000, 1)


def asking() -> scripts.RequestScript[Outcome]:
    return (yield command("ask"))


def test_a_transfer_script_can_continue_after_a_failed_transfer() -> None:
    def script() -> TransferScript[bytes]:
        try:
            return (yield Transfer((b"fails",)))
        except TransferError:
            return (yield Transfer((b"works",)))

    def transfer(wanted: Transfer) -> bytes:
        if wanted.sends == (b"fails",):
            raise TransferError(Trouble.ABSENT, "no acknowledgement")
        return wanted.sends[0]

    assert scripts.run_transfer_script(script(), transfer) == b"works"
    with pytest.raises(StopIteration) as end:
        next(scripts.says_nothing(5))
    assert end.value.value == 5


def test_a_measurement_ends_a_request_that_waits_for_it_and_no_other(session: ScriptRunner, ledger: Ledger) -> None:
    once = replace(command("once"), is_sample=lambda sample: sample.dev_ticks == 7)
    session.start(once, 0)
    assert session.wants_samples
    early, right = Measurement(54, 0, 6), Measurement(54, 0, 7)
    assert [session.on_sample(one) for one in (early, right, right)] == [None, Reply((), right), None]
    assert not session.wants_samples
    assert strays(ledger) == (0, 0)
    session.start(once, 0)
    assert session.on_message("ERR", 1) == Rejection(("ERR",))
    session.start(once, 0)
    assert session.on_time(TIMEOUT_NS) == Silence(())
    session.start(command("save"), 0)
    assert (session.wants_samples, session.on_sample(right)) == (False, None)
    assert session.deadline_ns is not None
