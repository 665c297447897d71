"""Boot loader of a HiPNUC device on a UART: packets, decoder of the replies, and the script of an update.

Source: facts in the vendor's public SDK (section "Firmware update" of the newer firmware). All values little-endian:

    ping      5A A6                    →  5A A7, version u8×4, options u16, crc u16
    packet    5A, type, length u16, crc u16, payload
    reply     5A A1 acknowledges a packet, 5A A2 requests it again, 5A A3 aborts the data
    command   packet of type A4: tag, flags, 0, count, count × u32     →  A1, then a packet of type A4
    data      packet of type A5                                        →  A1; after the last one also a packet A4

`crc` is CRC-16/XMODEM over bytes 0…3 and the payload, as in the frames of the application. The reply to a command has
the tag A7 (property: status, value) or A0 (status, tag of the command). Status 0 is success. `AT+RST` restarts the
device. Then the boot loader waits for a ping for a short time and starts the application.
"""

import struct
from binascii import crc_hqx as crc16_xmodem
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Final

from imud.contracts.codec import BadFrame, BadReason, CodecEvent
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
from imud.contracts.script import Message, Reply, ReplyFrame, Request, RequestScript, Silence, never, pause
from imud.drivers.hipnuc.uart import commands
from imud.model.errors import BadArgument, Rejected
from imud.model.ledger import Ledger
from imud.model.units import NS_PER_MS, NS_PER_S, uart_byte_ns

START_BYTE: Final = 0x5A
ACK, NAK, ABORT, COMMAND, DATA, PING, PING_REPLY = 0xA1, 0xA2, 0xA3, 0xA4, 0xA5, 0xA6, 0xA7
HEADER: Final = struct.Struct("<BBHH")  # start byte, type, payload length, CRC
PING_BYTES: Final = 10  # length of the reply to a ping
PAYLOAD_MAX: Final = 1024  # Maximum payload of a packet, bytes. The vendor's tool has a limit of 506.
TAG_ERASE, TAG_WRITE, TAG_PROPERTY, TAG_RESET = 0x02, 0x04, 0x07, 0x0B
TAG_GENERIC, TAG_PROPERTY_REPLY = 0xA0, 0xA7
PROPERTY_FLASH_BYTES, PROPERTY_SECTOR_BYTES, PROPERTY_PACKET_BYTES, PROPERTY_FLASH_START = 0x04, 0x05, 0x0B, 0x03
UNKNOWN_PROPERTY: Final = 10300  # status of a property that the boot loader does not know
RESTART: Final = b"AT+RST\r\n"

PING_NS: Final = 50 * NS_PER_MS  # wait for the reply to a ping
COMMAND_NS: Final = 5 * NS_PER_S  # wait for the reply to a command or a data packet, as the vendor's tool
FINAL_NS: Final = NS_PER_S  # wait for the final status after the acknowledgement of the last data packet
ERASE_NS: Final = 30 * NS_PER_S  # wait for the end of an erase: 1 MiB in sectors of 2 KiB takes about 20 s
RESEND_MAX: Final = 5  # maximum number of times that imud sends one packet
QUIET_NS: Final = 300 * NS_PER_MS  # pause after which the boot loader has discarded an incomplete packet


def packet(kind: int, payload: bytes) -> bytes:
    """Return a packet."""
    head = struct.pack("<BBH", START_BYTE, kind, len(payload))
    return head + crc16_xmodem(payload, crc16_xmodem(head, 0)).to_bytes(2, "little") + payload


def command(tag: int, *values: int) -> bytes:
    """Return a packet with a command or a reply."""
    return packet(COMMAND, struct.pack(f"<BBBB{len(values)}I", tag, 0, 0, len(values), *values))


def ping_reply() -> bytes:
    """Return the reply of a boot loader to a ping."""
    head = struct.pack("<BB4sH", START_BYTE, PING_REPLY, b"\x00\x02\x01P", 0)
    return head + crc16_xmodem(head, 0).to_bytes(2, "little")


class KbootCodec:
    """Decoder of the replies. Synchronization: one thread. Memory: one packet.

    A frame of the application that is still on the wire has the form of a data packet: it counts as ignored.
    """

    def __init__(self, ledger: Ledger) -> None:
        self.ledger = ledger
        self._tail = b""
        self._bad_ahead = 0  # rest of a damaged packet by its length field, bytes from the start of the tail

    def feed(self, data: bytes) -> Sequence[CodecEvent]:
        """Decode the next bytes of the stream. Return the completed events. Never raises an exception."""
        self.ledger.bytes_in += len(data)
        return self._scan(self._tail + data, give_up=False)

    def flush(self) -> Sequence[CodecEvent]:
        """Drop an incomplete reply. Return the complete replies inside it."""
        return self._scan(self._tail, give_up=True)

    def reset(self) -> None:
        """Count the pending bytes as skipped."""
        self.ledger.bytes_skipped += len(self._tail)
        self.ledger.bytes_pending = self._bad_ahead = 0
        self._tail = b""

    def _scan(self, data: bytes, *, give_up: bool) -> list[CodecEvent]:
        events: list[CodecEvent] = []
        at, total = 0, len(data)
        while at < total:
            after = self._decode(data, at, give_up, events)
            if after == at:
                break
            at = after
        self._tail, self._bad_ahead = data[at:], max(self._bad_ahead - at, 0)
        self.ledger.bytes_pending = total - at
        return events

    def _decode(self, data: bytes, at: int, give_up: bool, events: list[CodecEvent]) -> int:
        """Decode the reply or the byte at `at`. Return its end, or `at` if it is incomplete."""
        if data[at] != START_BYTE:
            end = data.find(START_BYTE, at)
            return self._spend(at, len(data) if end < 0 else end)
        kind = data[at + 1] if at + 1 < len(data) else None
        size = {ACK: 2, NAK: 2, ABORT: 2, PING_REPLY: PING_BYTES, COMMAND: HEADER.size, DATA: HEADER.size}.get(
            kind or 0
        )
        if size is None and kind is not None:
            return self._spend(at, at + 1)
        whole = size is not None and at + size <= len(data)
        if whole and kind in (COMMAND, DATA):
            length = int.from_bytes(data[at + 2 : at + 4], "little")
            if length > PAYLOAD_MAX:
                return self._reject(data, at, at + 2, BadReason.LENGTH, events)
            size = HEADER.size + length
            whole = at + size <= len(data)
        if not whole or size is None:
            return self._reject(data, at, at + (size or 1), BadReason.CRC, events) if give_up else at
        raw = data[at : at + size]
        if kind in (COMMAND, DATA):
            good = crc16_xmodem(raw[HEADER.size :], crc16_xmodem(raw[:4], 0)) == int.from_bytes(raw[4:6], "little")
        else:
            good = kind != PING_REPLY or crc16_xmodem(raw[:8], 0) == int.from_bytes(raw[8:], "little")
        if not good:
            return self._reject(data, at, at + size, BadReason.CRC, events)
        self.ledger.bytes_in_good_frames += size
        self.ledger.frames_good += 1
        if kind == DATA:
            self.ledger.frames_ignored += 1
        else:
            self.ledger.frames_in_replies += 1
            events.append(ReplyFrame(data[at + 1], raw[HEADER.size :] if kind == COMMAND else raw[2:]))
        return at + size

    def _spend(self, at: int, end: int) -> int:
        """Count the bytes from `at` to `end` as bad inside a damaged packet, otherwise as skipped. Return `end`."""
        bad = max(min(self._bad_ahead, end) - at, 0)
        self.ledger.bytes_in_bad_frames += bad
        self.ledger.bytes_skipped += end - at - bad
        return end

    def _reject(self, data: bytes, at: int, end: int, reason: BadReason, events: list[CodecEvent]) -> int:
        """Reject a packet with the end `end` by its length field. Skip only its start byte: a reply can be inside."""
        if reason is BadReason.CRC:
            self.ledger.frames_bad_crc += 1
        else:
            self.ledger.frames_bad_length += 1
        events.append(BadFrame(reason, data[at:end]))
        self._bad_ahead = max(self._bad_ahead, end)
        return self._spend(at, at + 1)


# --- requests ---------------------------------------------------------------------------------------------------------


def _of(*kinds: int) -> Callable[[Message], bool]:
    return lambda message: isinstance(message, ReplyFrame) and message.frame_id in kinds


def _replies_to(tag: int) -> Callable[[Message], bool]:
    """Return a test for the reply to the command `tag`."""

    def holds(message: Message) -> bool:
        if not isinstance(message, ReplyFrame) or message.frame_id != COMMAND or len(message.payload) < 12:
            return False
        if tag == TAG_PROPERTY:
            return message.payload[0] == TAG_PROPERTY_REPLY
        return message.payload[0] == TAG_GENERIC and int.from_bytes(message.payload[8:12], "little") == tag

    return holds


def ping() -> Request:
    """Return the request that only the boot loader answers."""
    return Request(
        bytes([START_BYTE, PING]), "boot loader, ping", _of(PING_REPLY), never, never, PING_NS, repeatable=True
    )


def _command(name: str, tag: int, *values: int, timeout_ns: int = COMMAND_NS) -> Request:
    return Request(
        command(tag, *values), f"boot loader, {name}", _replies_to(tag), _of(NAK), _of(ACK), timeout_ns, repeatable=True
    )


def _asked(name: str, tag: int, *values: int, timeout_ns: int = COMMAND_NS) -> RequestScript[tuple[int, int]]:
    """Send a command. Return status and second value of the reply. Raises LostContact."""
    request = _command(name, tag, *values, timeout_ns=timeout_ns)
    for _ in range(RESEND_MAX):
        outcome = yield request
        if isinstance(outcome, Reply):
            return struct.unpack_from("<2I", outcome.frames[-1].payload, 4)
        if isinstance(outcome, Silence):
            raise LostContact(f"{request.name}: expected a reply within {timeout_ns / NS_PER_S:g} s, got none")
    raise LostContact(f"{request.name}: the boot loader received it damaged {RESEND_MAX} times; check the cable")


def _done(name: str, tag: int, *values: int, timeout_ns: int = COMMAND_NS) -> RequestScript[None]:
    """Send a command. Raises Rejected for a status other than 0, and LostContact."""
    status, _ = yield from _asked(name, tag, *values, timeout_ns=timeout_ns)
    _require_success(name, status)


def _status_of(reply: Reply) -> int:
    status: int = struct.unpack_from("<I", reply.frames[-1].payload, 4)[0]
    return status


def _require_success(name: str, status: int) -> None:
    if status:
        raise Rejected(f"boot loader, {name}: expected status 0, got {status}")


def _property(name: str, number: int) -> RequestScript[int]:
    status, value = yield from _asked(f"property {name}", TAG_PROPERTY, number, 0)
    _require_success(f"property {name}", status)
    return value


# --- the update -------------------------------------------------------------------------------------------------------


def update(target: Target, image: FirmwareImage, report: Report) -> RequestScript[None]:
    """Write an image and start it. Raises BadArgument, Rejected, LostContact."""
    for attempt in range(TRIES):
        try:
            yield from _enter(report)
            yield from _write(target, image, report, is_first=not attempt)
            break
        except LostContact:
            if attempt == TRIES - 1:
                raise
            yield pause(QUIET_NS)
    report(START, len(image.data), len(image.data))
    yield from _start_application()


def _start_application() -> RequestScript[None]:
    """Reset the device. Raises Rejected. The reply can be lost while the device restarts: the version shows it."""
    for _ in range(TRIES):
        outcome = yield _command("reset", TAG_RESET, timeout_ns=NS_PER_S)
        if isinstance(outcome, Reply):
            _require_success("reset", _status_of(outcome))
            return


def _enter(report: Report) -> RequestScript[None]:
    """Restart the device and stop its boot loader by a ping. A boot loader that already waits ignores the restart."""
    report(ENTER, 0, 0)
    yield Request(RESTART, "AT+RST", never, never, never, silent=True)
    for _ in range(ENTER_TRIES):
        if isinstance((yield ping()), Reply):
            return
    raise LostContact(
        f"expected the boot loader after AT+RST, got no reply to {ENTER_TRIES} pings; check the wires TX and RX and "
        "the baud rate; switch the device off and on if it sends no samples"
    )


def _write(target: Target, image: FirmwareImage, report: Report, *, is_first: bool) -> RequestScript[None]:
    """Erase the flash memory and write the image. `is_first`: no earlier transfer of this update can have erased it."""
    packet_bytes = yield from _property("maximum packet", PROPERTY_PACKET_BYTES)
    flash_bytes = yield from _property("flash size", PROPERTY_FLASH_BYTES)
    sector_bytes = yield from _property("sector size", PROPERTY_SECTOR_BYTES)
    start = yield from _flash_start()
    try:
        check_range(image, start, flash_bytes)
        if not 0 < sector_bytes <= flash_bytes:
            raise Rejected(f"boot loader: expected sectors of 1 … {flash_bytes} bytes, got {sector_bytes}")
        if image.address % sector_bytes:
            raise BadArgument(f"expected an image at a multiple of {sector_bytes} bytes, got {image.address:#010x}")
        if not 8 <= packet_bytes <= PAYLOAD_MAX:
            raise Rejected(f"boot loader: expected a maximum packet of 8 … {PAYLOAD_MAX} bytes, got {packet_bytes}")
    except (BadArgument, Rejected):
        yield _command("reset", TAG_RESET, timeout_ns=NS_PER_S)  # the application is unchanged: start it again
        raise
    total = len(image.data)
    report(ERASE, 0, total)
    try:
        yield from _done("erase", TAG_ERASE, image.address, total, timeout_ns=ERASE_NS)
    except Rejected as error:
        if not is_first:
            raise
        yield _command("reset", TAG_RESET, timeout_ns=NS_PER_S)
        raise EraseRefused(str(error)) from None
    yield from _done("write", TAG_WRITE, image.address, total)

    for at in range(0, total, packet_bytes):
        report(WRITE, at, total)
        is_last = at + packet_bytes >= total
        yield from _data(target, at, image.data[at : at + packet_bytes], is_last=is_last)
    report(WRITE, total, total)


def _data(target: Target, at: int, data: bytes, *, is_last: bool) -> RequestScript[None]:
    """Send a data packet, again after each NAK. After the last packet, the final status follows the acknowledgement,
    often in the same bytes.

    Raises LostContact without an acknowledgement: the boot loader counts the bytes, so imud cannot know whether it must
    send the packet again. Raises Rejected for a status other than 0.
    """
    wire_ns = (len(data) + HEADER.size) * uart_byte_ns(target.baud) if target.baud else 0
    name = f"boot loader, data at {at}"
    is_status = _replies_to(TAG_WRITE)
    is_acknowledgement = _of(ACK)

    def ends(message: Message) -> bool:
        return is_status(message) or (not is_last and is_acknowledgement(message))

    timeout_ns = (FINAL_NS if is_last else COMMAND_NS) + wire_ns
    request = Request(packet(DATA, data), name, ends, _of(NAK, ABORT), is_acknowledgement, timeout_ns, repeatable=True)
    for _ in range(RESEND_MAX):
        outcome = yield request
        if isinstance(outcome, Silence) and is_last and not outcome.frames:
            outcome = yield replace(request, payload=b"", timeout_ns=COMMAND_NS)
        if isinstance(outcome, Silence):
            if is_last and outcome.frames:  # not every boot loader sends the final status
                return
            raise LostContact(f"{name}: expected an acknowledgement, got none")
        if isinstance(outcome, Reply):
            if is_status(outcome.frames[-1]):
                _require_success("end of the data", _status_of(outcome))
            return
        if outcome.frames[-1].frame_id == ABORT:
            raise LostContact(f"{name}: the boot loader aborted the transfer")
    raise LostContact(f"{name}: the boot loader received it damaged {RESEND_MAX} times; check the cable")


def _flash_start() -> RequestScript[int | None]:
    """Return the first address of the flash memory; None if the boot loader does not know this property."""
    request = _command("property flash start", TAG_PROPERTY, PROPERTY_FLASH_START, 0, timeout_ns=NS_PER_S // 2)
    outcome = yield request
    if not isinstance(outcome, Reply):
        return None
    status, start = struct.unpack_from("<2I", outcome.frames[-1].payload, 4)
    return None if status else start


def _ping(_options: Any) -> Request:
    return ping()


def _find(target: Target) -> RequestScript[str]:
    """Search for the application, whose baud rate an update can change."""
    _, baud = yield from commands.find_after_boot((target.baud,))
    return commands.advice(baud, target.fixed_baud)


FIRMWARE: Final = Firmware(update, _ping, KbootCodec, _find)
