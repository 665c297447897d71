"""Network interfaces: existence from a file tree, details from prepared netlink replies, and waits for changes."""

import asyncio
import socket
import struct
from pathlib import Path

import pytest

from imud.links.netlink import CanDetails, absence, can_details, can_interfaces, parse_details, wait_until
from imud.model.errors import LinkError
from tests.support.event_loops import in_loop


def interface(sys: Path, name: str, kind: int, flags: int) -> None:
    folder = sys / "class/net" / name
    folder.mkdir(parents=True)
    (folder / "type").write_text(f"{kind}\n")
    (folder / "flags").write_text(f"{flags:#x}\n")


def test_absence_says_what_to_do(tmp_path: Path) -> None:
    interface(tmp_path, "can0", 280, 0x40081)
    interface(tmp_path, "can1", 280, 0x40080)
    interface(tmp_path, "eth0", 1, 0x1003)
    assert absence("can0", tmp_path) == ""
    assert "can1 is down" in absence("can1", tmp_path)
    assert "can9 does not exist" in absence("can9", tmp_path)
    with pytest.raises(LinkError, match="eth0 is not a CAN interface"):
        absence("eth0", tmp_path)
    assert can_interfaces(tmp_path) == ["can0"]
    assert can_interfaces(tmp_path / "none") == []


def attribute(kind: int, data: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(data), kind) + data + bytes(-len(data) % 4)


def answer(info: bytes) -> bytes:
    body = bytes(16) + attribute(3, b"can0\0") + (attribute(18, info) if info else b"")
    return struct.pack("=IHHII", 16 + len(body), 16, 0, 1, 0) + body


def test_details_of_an_interface(monkeypatch: pytest.MonkeyPatch) -> None:
    limits_s: list[float] = []
    monkeypatch.setattr(socket.socket, "settimeout", lambda _socket, limit_s: limits_s.append(limit_s))
    timing = struct.pack("=8I", 250_000, 875, 0, 0, 0, 0, 0, 0)
    data = attribute(1, timing) + attribute(4, struct.pack("=I", 3))
    info = attribute(1, b"can\0") + attribute(2, data)
    assert parse_details(answer(info)) == CanDetails(250_000, 3)
    assert parse_details(answer(attribute(1, b"vcan\0"))) == CanDetails(None, None)
    assert parse_details(answer(b"")) == CanDetails(None, None)
    assert parse_details(struct.pack("=IHHIIi", 20, 2, 0, 1, 0, -19)) == CanDetails(None, None)
    assert parse_details(answer(attribute(2, b"\1\0\1\0"))[:-1]) == CanDetails(None, None)
    assert (can_details("lo"), limits_s) == (CanDetails(None, None), [1])
    with pytest.raises(LinkError, match="nosuch0"):
        can_details("nosuch0")


@in_loop
async def test_a_wait_ends_without_a_reader() -> None:
    held = iter([False, True])
    waiting = asyncio.create_task(wait_until(lambda: next(held)))
    await asyncio.sleep(0)
    waiting.cancel()
    await asyncio.gather(waiting, return_exceptions=True)
    await wait_until(lambda: next(held))
