"""Conversations with a HiPNUC module: who it is, how it is set, and no reply, refusals and late replies told apart."""

from collections.abc import Callable, Sequence
from typing import TypeVar

import pytest

from imud.contracts.session import Outcome, Rejection, Reply, RequestScript, Session, Silence
from imud.devices.hipnuc.uart.commands import OutputMessage, Query, ask, log_ontime
from imud.devices.hipnuc.uart.session import identify, read_settings
from imud.errors import NoReply, Rejected
from imud.ledger import Ledger
from tests.support.simulated_modules import run_script

T = TypeVar("T")
VERSION = ("PNAME=HI14R3", "BUILD=Oct 15 2024", "UUID=043995698D6E1708", "APP_VER=156", "BL_VER=109", "OK")
REPLIES = {
    "LOG USRCONFIG": ("ATT_MODE: 0", "OK"),
    "LOG COMCONFIG": ("BAUD=115200", "LOG HI91 ONTIME 0.01", "OK"),
    "LOG MAGCONFIG": ("MB=14.14, -2.08, -8.75", "OK"),
}


def hold(script: RequestScript[T], answer: Callable[[str], Outcome]) -> T:
    return run_script(script, lambda request: answer(request.name))


def test_identity() -> None:
    asked: list[str] = []

    def answer(name: str) -> Outcome:
        asked.append(name)
        return Reply(VERSION)

    identity = hold(identify(), answer)
    assert asked == ["LOG VERSION"]
    assert (identity.product, identity.serial_number, identity.firmware) == ("HI14R3", "043995698D6E1708", "1.5.6")
    assert identity.details is not None
    assert identity.details["APP_VER"] == "156"


def test_identity_without_a_version() -> None:
    assert hold(identify(), lambda _: Reply(("PNAME=CH0", "OK"))).firmware == ""


@pytest.mark.parametrize("lines", [(), ("PNAME=HI14R3",)])
def test_no_reply(lines: Sequence[str]) -> None:
    with pytest.raises(NoReply, match="LOG VERSION: expected lines up to OK"):
        hold(identify(), lambda _: Silence(tuple(lines)))


def test_refusal() -> None:
    with pytest.raises(Rejected, match="ERR 3"):
        hold(identify(), lambda _: Rejection(("ERR 3",)))


def test_settings_are_one_flat_mapping() -> None:
    assert hold(read_settings(), lambda name: Reply(REPLIES[name])) == {
        "ATT_MODE": "0",
        "BAUD": "115200",
        "COMCONFIG 1": "LOG HI91 ONTIME 0.01",
        "MB": "14.14, -2.08, -8.75",
    }


def test_a_module_without_magnetometer_may_keep_silent_about_it() -> None:
    settings = hold(read_settings(), lambda n: Silence(()) if n == "LOG MAGCONFIG" else Reply(REPLIES[n]))
    assert "ATT_MODE" in settings
    assert "MB" not in settings


@pytest.mark.parametrize("silent", ["LOG USRCONFIG", "LOG COMCONFIG"])
def test_settings_without_a_reply(silent: str) -> None:
    with pytest.raises(NoReply, match=silent):
        hold(read_settings(), lambda name: Silence(()) if name == silent else Reply(REPLIES[name]))


def test_a_late_version_is_not_taken_for_the_settings() -> None:
    """LOG VERSION times out, LOG USRCONFIG goes out, and only then the version arrives, with its OK."""
    ledger = Ledger()
    session = Session(ledger)
    session.start(ask(Query.VERSION), 0)
    assert isinstance(session.on_time(10**9), Silence)
    session.start(ask(Query.USRCONFIG), 10**9)
    assert [session.on_message(line, 10**9 + 1) for line in VERSION] == [None] * len(VERSION)
    assert (ledger.replies_late, ledger.replies_unsolicited) == (1, 0)
    assert session.on_message("ATT_MODE: 0", 10**9 + 2) is None
    assert session.on_message("OK", 10**9 + 2) == Reply(("ATT_MODE: 0", "OK"))


def test_the_late_ok_of_a_command_does_not_end_a_report() -> None:
    ledger = Ledger()
    session = Session(ledger)
    session.start(log_ontime(OutputMessage.HI91, 100), 0)
    session.on_time(10**9)
    session.start(ask(Query.VERSION), 10**9)
    outcomes = [session.on_message(line, 10**9 + 1) for line in ("OK", *VERSION)]
    assert outcomes == [None] * 6 + [Reply(VERSION)]
    assert ledger.replies_late == 1
