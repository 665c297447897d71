"""Cyclic sending: the message to the kernel, and the timer of the event loop."""

import asyncio
import struct

import pytest

from imud.formats.can import RAW_FRAME, CyclicFrame, pack_frame
from imud.links.cyclic_sender import LoopSender, setup
from imud.model.errors import LinkError

MS = 1_000_000
SYNC = CyclicFrame(0x80, False, b"\7", 10 * MS)


def test_the_message_to_the_broadcast_manager() -> None:
    """`struct bcm_msg_head` of linux/can/bcm.h on a 64-bit system has 56 bytes. The frame follows."""
    if struct.calcsize("P") != 8:
        pytest.skip("laid out otherwise")
    message = setup(CyclicFrame(0x18FEE9AA, True, b"\1\2", 1_002_500_000))
    assert len(message) == 56 + RAW_FRAME.size
    head = struct.unpack("=IIIIqqqqII", message[:56])
    assert head == (1, 3, 0, 0, 0, 0, 1, 2500, 0x98FEE9AA, 1)
    assert message[56:] == pack_frame(0x18FEE9AA, True, b"\1\2")


def run(late_ns: list[int], *, fail_after: int = 1 << 30) -> tuple[list[int], list[str]]:
    """Send; each timer fires late by the next of `late_ns`. Return the times of the frames and the reported errors."""
    now_ns, sent_at, errors = 0, list[int](), list[str]()

    async def story() -> None:
        loop, done = asyncio.get_running_loop(), asyncio.Event()

        class Link:
            def write(self, data: bytes) -> None:
                if len(sent_at) >= fail_after:
                    raise LinkError("full")
                assert data == pack_frame(0x80, False, b"\7")
                sent_at.append(now_ns)

            def sender_failed(self, error: LinkError) -> None:
                errors.append(str(error))
                done.set()

        def call_later(delay_s: float, callback: object, *arguments: object) -> asyncio.TimerHandle:
            nonlocal now_ns
            if not late_ns:
                done.set()
                return loop_call_later(0, lambda: None)
            now_ns += round(delay_s * 1e9) + late_ns.pop(0)
            return loop_call_later(0, callback, *arguments)  # type: ignore[arg-type]  # as it was given

        loop_call_later = loop.call_later
        loop.call_later = call_later  # type: ignore[assignment]  # the test's own time
        sender = LoopSender(Link(), [SYNC], lambda: now_ns)
        await done.wait()
        sender.close()
        sender.close()

    asyncio.run(story())
    return [sent_ns // MS for sent_ns in sent_at], errors


def test_deadlines_are_absolute_and_a_failed_link_ends_them() -> None:
    assert run([3 * MS, 0, 9 * MS, 0]) == ([0, 13, 20, 39, 40], [])
    assert run([35 * MS, 0]) == ([0, 45, 50], [])
    assert run([-MS, 0, 0]) == ([0, 10, 20], []), "a timer that fires early waits on"
    assert run([0] * 5, fail_after=2) == ([0, 10], ["full"])
