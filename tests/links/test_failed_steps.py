"""A failed step must close all sockets and timers. Every step after `socket()` fails once."""

import asyncio
import errno
import os
import socket
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import msgspec
import pytest

from imud.formats.can import CanFilter, CyclicFrame, pack_filters, pack_frame
from imud.host import netlink
from imud.links import LINKS
from imud.links.cyclic_sender import KernelSender, LoopSender
from imud.links.socketcan import SO_RCVBUFFORCE, SocketCanLink, SocketCanOptions, open_raw
from imud.model.errors import LinkDenied, LinkError, LinkMissing
from tests.support.documented import check_schema
from tests.support.event_loops import in_loop

FRAMES = [CyclicFrame(number, False, b"", 1_000_000) for number in (1, 2)]
BUFFER_BYTES = 1 << 20
NO_RATES = {"bitrate": 0, "data_bitrate": 0}


class FakeSocket:
    """A socket. Its call number `fails_at` fails."""

    def __init__(self, fails_at: int = 0, error: int = errno.ENODEV) -> None:
        self._fails_at, self._error = fails_at, error
        self.calls: list[tuple[object, ...]] = []
        self.closed = False

    def _call(self, *arguments: object) -> int:
        self.calls.append(arguments)
        if len(self.calls) == self._fails_at:
            raise OSError(self._error, os.strerror(self._error))
        return BUFFER_BYTES

    setsockopt = getsockopt = bind = connect = send = _call

    def fileno(self) -> int:
        return 3

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize(
    ("make", "steps"),
    [(lambda: open_raw(SocketCanOptions(interface="can0"), []), 6), (lambda: KernelSender("can0", FRAMES), 3)],
    ids=["raw", "broadcast manager"],
)
def test_a_socket_is_closed_when_a_step_fails(
    monkeypatch: pytest.MonkeyPatch, make: Callable[[], object], steps: int
) -> None:
    for fails_at in range(1, steps + 1):
        made = FakeSocket(fails_at)
        monkeypatch.setattr(socket, "socket", lambda *_, made=made: made)
        with pytest.raises(OSError, match="No such device"):
            make()
        assert (made.closed, len(made.calls)) == (True, fails_at)


def test_a_raw_socket_has_the_permitted_buffer(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fourth call fails without CAP_NET_ADMIN. The normal option then sets the buffer."""
    made = FakeSocket(4, errno.EPERM)
    monkeypatch.setattr(socket, "socket", lambda *_: made)
    assert open_raw(SocketCanOptions(interface="can0"), []) is made  # type: ignore[comparison-overlap]  # the fake
    assert made.calls[2] == (socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
    assert made.calls[3] == (socket.SOL_SOCKET, SO_RCVBUFFORCE, BUFFER_BYTES // 2), "the kernel doubles the value"
    assert made.calls[4] == (socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES // 2)
    assert (made.calls[-1], made.closed) == ((("can0",),), False)
    KernelSender("can0", FRAMES).close()
    assert made.closed


@pytest.fixture
def sys_with_can0(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "class/net/can0"
    folder.mkdir(parents=True)
    (folder / "type").write_text(f"{netlink.ARPHRD_CAN}\n")
    (folder / "flags").write_text(f"{netlink.IFF_UP:#x}\n")
    monkeypatch.setattr(netlink, "can_details", lambda name: netlink.CanDetails(None, None))
    return tmp_path


def link_of(made: FakeSocket, sys: Path) -> SocketCanLink:
    """Return a link with the socket `made`."""
    settings = SocketCanOptions(interface="can0")
    return SocketCanLink(settings, sys=sys, open_socket=lambda *_: made)  # type: ignore[arg-type]  # the fake


@pytest.mark.parametrize(
    ("fails_at", "error", "kind"),
    [(1, errno.ENODEV, LinkMissing), (2, errno.EPERM, LinkDenied), (3, errno.EAFNOSUPPORT, LinkError)],
)
def test_a_link_that_cannot_be_set_up_is_closed(
    sys_with_can0: Path, fails_at: int, error: int, kind: type[LinkError]
) -> None:
    made = FakeSocket(fails_at, error)
    link = link_of(made, sys_with_can0)
    with pytest.raises(LinkError) as caught:
        link.open()
    assert type(caught.value) is kind
    assert made.closed
    with pytest.raises(LinkError, match="not open"):
        link.write(b"")


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (errno.ENOBUFS, "queue is full"), (errno.EAGAIN, "queue is full"), (errno.ENETDOWN, "is down"),
        (errno.ENODEV, "is missing"), (errno.EIO, "^can0: Input/output error$"),
    ],
)  # fmt: skip
def test_a_refused_frame_is_explained(sys_with_can0: Path, error: int, words: str) -> None:
    made = FakeSocket(4, error)  # after two options and the buffer size
    link = link_of(made, sys_with_can0)
    link.open()
    with pytest.raises(LinkError, match=words):
        link.write(pack_frame(1, False, b""))


@in_loop
async def test_a_sender_whose_second_frame_is_refused_leaves_no_timer() -> None:
    written: list[bytes] = []
    errors: list[LinkError] = []

    class Link:
        def write(self, data: bytes) -> None:
            if len(written) == 1:
                raise LinkError("full")
            written.append(data)

        def sender_failed(self, error: LinkError) -> None:
            errors.append(error)

    with pytest.raises(LinkError, match="full"):
        LoopSender(Link(), FRAMES)
    await asyncio.sleep(0.01)  # ten periods of the first frame
    assert (len(written), errors) == (1, [])


class FakeSender:
    def __init__(self, made: list["FakeSender"]) -> None:
        self.closed = False
        made.append(self)

    def close(self) -> None:
        self.closed = True


def test_a_link_has_one_cyclic_sender_at_a_time(monkeypatch: pytest.MonkeyPatch, sys_with_can0: Path) -> None:
    made: list[FakeSender] = []
    monkeypatch.setattr("imud.links.socketcan.KernelSender", lambda *_: FakeSender(made))
    link = link_of(FakeSocket(), sys_with_can0)
    link.open()
    for expected in ([False], [True, False]):
        link.send_cyclic(FRAMES)
        assert [sender.closed for sender in made] == expected
    link.close()
    assert [sender.closed for sender in made] == [True, True]


@in_loop
async def test_an_open_link_changes_its_filters_and_sends_without_the_manager(
    monkeypatch: pytest.MonkeyPatch, sys_with_can0: Path
) -> None:
    link = link_of(made := FakeSocket(), sys_with_can0)
    link.open()
    link.filters = wanted = [CanFilter(0x65, 0x7FF, False)]
    set_filters = socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, pack_filters(wanted)
    assert (link.filters, made.calls[-1]) == (wanted, set_filters)
    errors = [OSError(errno.ENODEV, ""), OSError(errno.EPROTONOSUPPORT, "")]
    monkeypatch.setattr("imud.links.socketcan.KernelSender", Mock(side_effect=errors))
    with pytest.raises(LinkMissing, match="can0 is missing"):
        link.send_cyclic(FRAMES)
    link.send_cyclic(FRAMES)
    assert made.calls[-2:] == [(pack_frame(number, False, b""),) for number in (1, 2)]
    link.close()


@pytest.mark.parametrize("name", [name for name in LINKS if name != "memory"])
def test_keys_of_a_link_accept_the_documented_values(name: str) -> None:
    assert check_schema(f"Link `{name}`", LINKS[name].settings)


TERMS = {"baud": 115200, "direction": "auto", "echo": "auto"}
CLAIMS: list[tuple[str, dict[str, object], tuple[object, ...]]] = [
    ("uart", {"port": "/dev/a"}, ("/dev/a", "port", False, None, "", {})),
    ("spi", {"port": "/dev/spidev0.0"}, ("/dev/spidev0.0", "port", False, None, "", {})),
    ("i2c", {"bus": 3}, ("/dev/i2c-3", "bus", True, None, "address", {})),
    ("i2c", {"bus": 3, "address": 25}, ("/dev/i2c-3", "bus", True, 25, "address", {})),
    ("rs485", {"line": "/dev/b", "address": 7}, ("/dev/b", "line", True, 7, "address", TERMS)),
    ("rs485", {"line": "/dev/b"}, ("/dev/b", "line", True, None, "address", TERMS)),
    ("socketcan", {"interface": "can0"}, ("can0", "interface", True, None, "", NO_RATES)),
    ("socketcan", {"interface": "1", "backend": "slcan"}, ("1 (slcan)", "interface", True, None, "", NO_RATES)),
    ("socketcan", {"interface": "/d", "backend": "slcan"}, ("/d", "interface", False, None, "", NO_RATES)),
]


@pytest.mark.parametrize(("name", "keys", "expected"), CLAIMS)
def test_claims_of_a_link(name: str, keys: dict[str, object], expected: tuple[object, ...]) -> None:
    """Two devices may not use the same serial port or chip select. They may share a bus with other addresses."""
    row = LINKS[name]
    (claim,) = row.claims(msgspec.convert(keys, row.settings))
    assert (claim.place, claim.key, claim.shared, claim.part, claim.part_key, claim.terms) == expected
