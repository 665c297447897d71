"""Scripts, outcomes and transfers, without a runner."""

from inspect import GEN_CLOSED, getgeneratorstate

import pytest

from imud.contracts import script as scripts
from imud.contracts.script import Outcome, Reply, ReplyFrame, Request, Transfer, TransferScript, never
from imud.model.errors import TransferError, Trouble


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
    request = Request(b"ask", "ask", never, never, never)
    assert (request.timeout_ns, request.messages_min, never("a")) == (500_000_000, 1, False)
    assert scripts.pause(50, baud=9) == Request(b"", "pause", never, never, never, 50, baud=9)
    reply = Reply((ReplyFrame(6, b"x"), "OK"))
    assert (reply.frames, reply.lines, reply.sample) == ((ReplyFrame(6, b"x"),), ("OK",), None)


def asking() -> scripts.RequestScript[Outcome]:
    return (yield Request(b"ask", "ask", never, never, never))


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
