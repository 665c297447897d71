"""Buses of python-can, on its virtual one."""

import asyncio
import threading
from collections.abc import Sequence

import can
import msgspec
import pytest

from imud.contracts.link import CanLink
from imud.errors import LinkError
from imud.formats.can import CanFilter, CanFrame, pack_frame
from imud.links import LINKS
from imud.links.can.link import LINK, SocketCanSettings, pack_filters
from imud.links.can.python_can import PythonCanLink
from tests.support.daemon_process import LIMIT_S


def make(channel: str, **keys: object) -> CanLink:
    row = LINKS["socketcan"]
    return row.make_can(msgspec.convert({"interface": channel, "backend": "virtual", **keys}, row.settings))


def test_frames_pass_the_filters_and_come_in_the_loops_thread() -> None:
    async def story() -> list[CanFrame]:
        link = make("pass")
        link.filters = [CanFilter(0x65, 0x7FF, False)]
        await link.wait_present()
        link.open()
        got: list[CanFrame] = []
        threads: set[threading.Thread] = set()
        done = asyncio.Event()

        def on_frames(frames: Sequence[CanFrame]) -> None:
            threads.add(threading.current_thread())
            got.extend(frames)
            if len(got) == 2:
                done.set()

        link.start(on_frames, lambda news, problem: None, lambda error: None)
        with can.Bus("pass", "virtual") as far:
            for can_id, extended in ((0x65, False), (0x66, False), (0x65, True), (0x65, False)):
                far.send(can.Message(arbitration_id=can_id, is_extended_id=extended, data=b"\1\2"))
            await asyncio.wait_for(done.wait(), LIMIT_S)
        assert threads == {threading.current_thread()}
        link.close()
        link.close()
        return got

    frames = asyncio.run(story())
    assert [frame[:3] for frame in frames] == [(0x65, False, b"\1\2")] * 2
    assert 0 < frames[0].t_rx_ns <= frames[1].t_rx_ns
    assert "can pass" not in [thread.name for thread in threading.enumerate()]


def test_commands_go_out() -> None:
    link = make("out")
    link.open()
    with can.Bus("out", "virtual") as far:
        link.write(pack_frame(0x123, False, b"\7") + pack_frame(0x1234, True, b""))
        sent = [far.recv(LIMIT_S) for _ in range(2)]
    link.close()
    assert [(m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in sent if m] == [
        (0x123, False, b"\7"),
        (0x1234, True, b""),
    ]
    with pytest.raises(LinkError, match="not open"):
        link.write(b"")


def test_settings_of_other_backends() -> None:
    with pytest.raises(msgspec.ValidationError, match="the system sets it"):
        msgspec.convert({"interface": "can0", "bitrate": 500000}, SocketCanSettings)
    assert make("rate", bitrate=250000).bitrate == 250000
    assert LINK.make_can(SocketCanSettings(interface="can0")).title == "can0"
    with pytest.raises(LinkError, match="cannot be opened"):
        PythonCanLink("nosuch", "x").open()


def test_filters_as_the_kernel_takes_them() -> None:
    packed = pack_filters([CanFilter(0x65, 0x7FF, False), CanFilter(0x18FEE900, 0x03FFFF00, True)])
    assert packed.hex() == "65000000ff0700c0" + "00e9fe9800ffffc3"
