"""Firmware update of a HiPNUC device on CANopen: the object 0x1F51 (program control, CiA 302).

Source: facts in the vendor's public SDK (section "Firmware update" of the newer firmware). Sub-indices of 0x1F51:

    5   enter the boot loader     expedited write of 0   →  command 0x00, index, sub-index
    6   confirm the boot loader   expedited write of 0   →  0x60
    1   image                     segmented download     →  0x60, then 0x20 and 0x30 in turn
    9   start the application     expedited write of 0   →  0x60

Segmented download: CiA 301, section 7.2.4.3. The boot loader reports neither its flash memory nor its product.
"""

from typing import Any, Final

from imud.contracts.command import Target
from imud.contracts.firmware import (
    ENTER,
    ENTER_TRIES,
    ERASE,
    START,
    TRIES,
    WRITE,
    EraseRefused,
    Firmware,
    FirmwareImage,
    LostContact,
    Report,
    check_range,
)
from imud.contracts.script import Message, Rejection, Reply, ReplyFrame, Request, RequestScript, Silence, never, pause
from imud.drivers.hipnuc.canopen.cia301 import (
    ABORT,
    SDO_BYTES,
    SDO_REPLY,
    SDO_REQUEST,
    WRITTEN,
    Aborted,
    abort_frame,
    abort_text,
    answers,
    write_frame,
)
from imud.formats.can import pack_frame
from imud.model.units import NS_PER_MS, NS_PER_S

PROGRAM: Final = 0x1F51
IMAGE, ENTER_LOADER, CONFIRM, START_APPLICATION = 1, 5, 6, 9
ENTERED: Final = 0x00  # command of the reply to ENTER_LOADER
BEGIN_DOWNLOAD: Final = 0x21  # segmented download with its size
SEGMENT_BYTES: Final = 7
LAST_BYTES: Final = 8  # number of bytes of the last segment plus the number in its command, in the vendor's tool
SEGMENT_REPLIES: Final = (0x20, 0x30)  # reply to a segment, by its toggle bit
ABSENT: Final = (0x0602_0000, 0x0609_0011)  # abort codes of an application that lacks the object or the sub-index
TIMED_OUT: Final = 0x0504_0000  # abort code after a segment without a reply
ANSWER_NS: Final = 100 * NS_PER_MS  # wait for the reply to an expedited write, as the vendor's tool
BOOT_NS: Final = 20 * NS_PER_MS  # time from the reply to ENTER_LOADER to the start of the boot loader
ERASE_NS: Final = 30 * NS_PER_S  # wait for the first reply, because the boot loader erases the flash memory before it
SEGMENT_NS: Final = 4 * NS_PER_S  # wait for the reply to a segment, as the vendor's tool
QUIET_NS: Final = 300 * NS_PER_MS  # pause before another transfer


def _write(node: int, sub: int, reply: int, name: str) -> Request:
    payload = pack_frame(SDO_REQUEST + node, False, write_frame(PROGRAM, sub, bytes(4)))
    ends = answers(node, PROGRAM, sub, (reply, WRITTEN))
    refuses = answers(node, PROGRAM, sub, (ABORT,))
    return Request(payload, f"node {node}, {name}", ends, refuses, never, ANSWER_NS, repeatable=True)


def ping(node: int) -> Request:
    """Return the request that only the boot loader confirms."""
    return _write(node, CONFIRM, WRITTEN, "confirm the boot loader")


def update(target: Target, image: FirmwareImage, report: Report) -> RequestScript[None]:
    """Write an image and start it. Raises BadArgument, Rejected, LostContact."""
    node: int = target.settings.node
    check_range(image, None)
    total = len(image.data)
    for attempt in range(TRIES):
        try:
            report(ENTER, 0, total)
            yield from _enter(node)
            yield from _download(node, image.data, report, is_first=not attempt)
            break
        except LostContact:
            payload = pack_frame(SDO_REQUEST + node, False, abort_frame(PROGRAM, IMAGE, TIMED_OUT))
            yield Request(payload, f"node {node}, abort the download", never, never, never, silent=True)
            if attempt == TRIES - 1:
                raise
            yield pause(QUIET_NS)
    report(START, total, total)
    yield from _start_application(node)


def _start_application(node: int) -> RequestScript[None]:
    """Start the application. Raises Aborted.

    The reply can be lost while the device restarts: the version shows the result. An application that already runs
    lacks the object.
    """
    request = _write(node, START_APPLICATION, WRITTEN, "start the application")
    for _ in range(TRIES):
        outcome = yield request
        if isinstance(outcome, Rejection) and _abort_code(outcome) not in ABSENT:
            raise Aborted(request.name, _abort_code(outcome))
        if not isinstance(outcome, Silence):
            return


def _abort_code(outcome: Rejection) -> int:
    return int.from_bytes(outcome.frames[-1].payload[4:], "little")


def _enter(node: int) -> RequestScript[None]:
    enter = _write(node, ENTER_LOADER, ENTERED, "enter the boot loader")
    refusal: Rejection | None = None
    for _ in range(ENTER_TRIES):
        outcome = yield enter
        refusal = outcome if isinstance(outcome, Rejection) else refusal
        if isinstance(outcome, Reply):
            yield pause(BOOT_NS)
        if isinstance((yield ping(node)), Reply):
            return
        yield pause(BOOT_NS)
    if refusal is not None:
        raise Aborted(enter.name, _abort_code(refusal))
    raise LostContact(
        f"{enter.name}: expected a confirmation, got none after {ENTER_TRIES} requests; check the node number, the bit "
        "rate and the termination of the bus"
    )


def _download(node: int, data: bytes, report: Report, *, is_first: bool) -> RequestScript[None]:
    """Write the image. `is_first`: no earlier transfer of this update can have erased the flash memory."""
    total = len(data)
    report(ERASE, 0, total)
    begin = bytes([BEGIN_DOWNLOAD]) + write_frame(PROGRAM, IMAGE, total.to_bytes(4, "little"))[1:]
    name = f"node {node}, begin the download"
    refuses = answers(node, PROGRAM, IMAGE, (ABORT,))
    ends = answers(node, PROGRAM, IMAGE, (WRITTEN,))
    payload = pack_frame(SDO_REQUEST + node, False, begin)
    outcome = yield Request(payload, name, ends, refuses, never, ERASE_NS, repeatable=True)
    if isinstance(outcome, Silence):
        raise LostContact(f"{name}: expected a reply within {ERASE_NS // NS_PER_S} s, got none")
    if isinstance(outcome, Rejection):
        code = _abort_code(outcome)
        if code in ABSENT:
            raise LostContact(f"{name}: expected the boot loader, got the application: the device has restarted")
        refusal = Aborted(name, code)
        if not is_first:
            raise refusal
        yield _write(node, START_APPLICATION, WRITTEN, "start the application")
        raise EraseRefused(str(refusal))
    for number, at in enumerate(range(0, total, SEGMENT_BYTES)):
        report(WRITE, at, total)
        part = data[at : at + SEGMENT_BYTES]
        yield from _segment(node, at, part, toggle=number % 2, last=at + SEGMENT_BYTES >= total)
    report(WRITE, total, total)


def _segment(node: int, at: int, part: bytes, *, toggle: int, last: bool) -> RequestScript[None]:
    """Send a segment. Raises LostContact also after an abort: a repeated segment has a wrong toggle bit."""
    reply_id, expected = SDO_REPLY + node, SEGMENT_REPLIES[toggle]

    def ends(message: Message) -> bool:
        if not isinstance(message, ReplyFrame) or message.frame_id != reply_id:
            return False
        return len(message.payload) == SDO_BYTES and message.payload[0] == expected

    # The last segment has 8 - n bytes in the vendor's tool, and 7 - n in CiA 301. imud follows the vendor's tool.
    command = toggle << 4 | (last and (LAST_BYTES - len(part)) << 1 | last)
    frame = bytes([command]) + part.ljust(SEGMENT_BYTES, b"\0")
    name = f"node {node}, segment at {at}"
    refuses = answers(node, PROGRAM, IMAGE, (ABORT,))
    payload = pack_frame(SDO_REQUEST + node, False, frame)
    outcome = yield Request(payload, name, ends, refuses, never, SEGMENT_NS, repeatable=True)
    if isinstance(outcome, Silence):
        raise LostContact(f"{name}: expected a reply within {SEGMENT_NS // NS_PER_S} s, got none")
    if isinstance(outcome, Rejection):
        code = _abort_code(outcome)
        raise LostContact(f"{name}: the boot loader aborted the download: {abort_text(code)} (0x{code:08X})")


def _ping(options: Any) -> Request:
    return ping(options.node)


FIRMWARE: Final = Firmware(update, _ping)
