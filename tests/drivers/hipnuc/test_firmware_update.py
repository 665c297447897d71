"""Firmware updates of the UART and CANopen drivers with simulated boot loaders: every fault at every step."""

import struct
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from imud.contracts.codec import BadFrame, message_of
from imud.contracts.command import Target
from imud.contracts.firmware import ERASE, EraseRefused, Firmware, FirmwareImage, LostContact, check_product
from imud.contracts.script import Outcome, Reply, ReplyFrame, Request
from imud.drivers.hipnuc.canopen.driver import DRIVER as CANOPEN
from imud.drivers.hipnuc.canopen.firmware import FIRMWARE as ON_CAN
from imud.drivers.hipnuc.uart import kboot
from imud.drivers.hipnuc.uart.driver import DRIVER as UART
from imud.drivers.hipnuc.uart.kboot import FIRMWARE as ON_UART
from imud.model.errors import BadArgument, CommandError, LinkError, Rejected
from imud.model.ledger import Ledger
from imud.sim.can_module import SentFrame
from imud.sim.hipnuc.boot_loader import APPLICATION, FLASH_BYTES, FLASH_START, LoaderFault, make_image
from tests.support.simulated_modules import CanopenBench, HipnucLine, run_script, unpack

FAULTS = ("lost request", "damaged request", "lost reply", "damaged reply", "power", "cable")
NEW = 170  # version of the image: 1.7.0


class Faults:
    """Faults by the number of the request."""

    def __init__(self) -> None:
        self.plan: dict[int, str] = {}
        self.step, self.present = 0, ""
        self.steps: list[str] = []  # names of the requests

    def begin(self, request: Request) -> None:
        self.step += 1
        self.steps.append(request.name)
        self.present = self.plan.get(self.step, "")

    def on_request(self, data: bytes) -> bytes:
        return self._pass_on(data, "request")

    def on_reply(self, data: bytes) -> bytes:
        return self._pass_on(data, "reply")

    def _pass_on(self, data: bytes, what: str) -> bytes:
        if self.present == f"lost {what}":
            return b""
        if self.present == f"damaged {what}" and data:
            middle = len(data) // 2
            return data[:middle] + bytes([data[middle] ^ 0x10]) + data[middle + 1 :]
        return data


class UartBench(HipnucLine):
    firmware: Firmware = ON_UART
    product, size = "HI14R3", 1000

    def __init__(self) -> None:
        super().__init__()
        self.faults, self.target = Faults(), Target(None, self.baud)
        self.application = self.codec
        self.loader = kboot.KbootCodec(self.ledger)
        self.durations_ns: list[int] = []  # time of each request

    def ask(self, request: Request) -> Outcome:
        start_ns = self.now_ns
        outcome = self._exchange(request)
        self.durations_ns.append(self.now_ns - start_ns)
        return outcome

    def _exchange(self, request: Request) -> Outcome:
        self.faults.begin(request)
        if self.faults.present == "power":
            self.module.reboot(self.now_ns)
        if self.faults.present == "cable":
            raise LinkError("the cable is removed")
        self.loader.flush()
        self.send(self.faults.on_request(self.session.start(request, self.now_ns)))
        if request.silent:
            return Reply(())
        while True:
            times = (self.module.next_ns(), self.session.deadline_ns)
            self.now_ns = max(self.now_ns, min(one for one in times if one is not None))
            for burst in self.module.advance(self.now_ns):
                outcome: Outcome | None = None
                for event in self.loader.feed(self.faults.on_reply(burst.data)):
                    message = message_of(event)
                    if message is not None:  # as in the daemon, messages after the outcome belong to no request
                        outcome = self.session.on_message(message, self.now_ns) or outcome
                if outcome is not None:
                    return outcome
            assert self.ledger.closes(), self.ledger.snapshot()
            if outcome := self.session.on_time(self.now_ns):
                return outcome

    def version(self) -> int:
        self.wait(2000)
        return 0 if self.module.loader else self.module.hardware.firmware

    def replug(self) -> None:
        self.session.cancel()
        self.loader.reset()


class CanUpdateBench(CanopenBench):
    firmware: Firmware = ON_CAN
    product, size = "HI14", 64

    def __init__(self) -> None:
        super().__init__()
        self.faults, self.ledger = Faults(), self.codec.ledger

    def _ask(self, request: Request) -> Outcome:
        self.faults.begin(request)
        if self.faults.present == "power":
            self.module.reboot(self.now_ns)
        if self.faults.present == "cable":
            raise LinkError("the cable is removed")
        payload = self.session.start(request, self.now_ns)
        if payload:
            can_id, data = unpack(payload)
            if data := self.faults.on_request(data):
                self.send(can_id, data)
        if request.silent:
            return Reply(())
        while True:
            if outcome := self.run(request.timeout_ns):
                return outcome

    def _hear(self, frame: SentFrame) -> Outcome | None:
        data = self.faults.on_reply(frame.data)
        assert self.ledger.closes()
        return super()._hear(frame._replace(data=data)) if data else None

    ask = _ask

    def version(self) -> int:
        self.run(2_000_000_000)
        return 0 if self.module.loader else self.module.objects.revision

    def replug(self) -> None:
        self.session.cancel()


Bench = UartBench | CanUpdateBench
BENCHES: tuple[Callable[[], Bench], ...] = (UartBench, CanUpdateBench)


def update(bench: Bench, image: FirmwareImage | None = None, plan: dict[int, str] | None = None) -> list[str]:
    """Run an update with faults. Return the phases that it reported. Raises the errors of the script, LinkError."""
    bench.faults = Faults()
    bench.faults.plan = plan or {}
    phases: list[str] = []
    target = bench.target if isinstance(bench.target, Target) else bench.target()
    made = image or FirmwareImage(APPLICATION, make_image(bench.product, NEW, bench.size))
    script = bench.firmware.update(target, made, lambda phase, _done, _total: phases.append(phase))
    try:
        run_script(script, bench.ask)
    finally:
        script.close()
        bench.phases = phases  # type: ignore[union-attr]
    return phases


@pytest.mark.parametrize("make", BENCHES)
def test_update_writes_and_starts_the_image(make: Callable[[], Bench]) -> None:
    bench = make()
    before = bench.version()
    phases = update(bench)
    assert before != NEW
    assert bench.version() == NEW
    assert bytes(bench.module.memory.data) == make_image(bench.product, NEW, bench.size)
    assert phases.index(ERASE) < phases.index("write")
    counts = bench.ledger
    assert counts.frames_bad() == 0
    assert counts.frames_in_replies >= len(set(phases))


def steps_of(make: Callable[[], Bench]) -> int:
    bench = make()
    update(bench)
    return bench.faults.step


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("make", BENCHES)
def test_second_update_succeeds_after_a_fault_at_any_step(make: Callable[[], Bench], fault: str) -> None:
    for step in range(1, steps_of(make) + 1):
        bench = make()
        if fault == "cable":
            with pytest.raises(LinkError):
                update(bench, plan={step: fault})
            bench.replug()
        else:  # one fault does not end an update
            update(bench, plan={step: fault})
            assert bench.version() == NEW or fault == "damaged request", (step, bench.faults.steps)
        update(bench)
        assert bench.version() == NEW, (step, bench.faults.steps)
        assert bytes(bench.module.memory.data) == make_image(bench.product, NEW, bench.size)


def test_damaged_data_packet_is_sent_again_alone() -> None:
    bench = UartBench()
    update(bench)
    steps = bench.faults.steps
    bench = UartBench()
    update(bench, plan={steps.index("boot loader, data at 256") + 1: "damaged request"})
    at = steps.index("boot loader, data at 512")
    assert bench.faults.steps == [*steps[:at], "boot loader, data at 256", *steps[at:]]
    assert bench.version() == NEW


@given(st.sampled_from(BENCHES), st.dictionaries(st.integers(1, 40), st.sampled_from(FAULTS), max_size=8))
def test_second_update_succeeds_after_several_faults(make: Callable[[], Bench], plan: dict[int, str]) -> None:
    bench = make()
    with suppress(CommandError, LinkError):
        update(bench, plan=plan)
    bench.replug()
    update(bench)
    assert bench.version() == NEW
    assert bench.ledger.closes()


@pytest.mark.parametrize("make", BENCHES)
def test_interrupted_update_leaves_the_device_in_its_boot_loader(make: Callable[[], Bench]) -> None:
    bench = make()
    last = steps_of(make) - 3
    with pytest.raises(LinkError):
        update(bench, plan={last: "cable"})
    bench.replug()
    bench.module.reboot(bench.now_ns)
    assert bench.version() == 0  # no application
    request = bench.firmware.ping(bench.settings if isinstance(bench, CanUpdateBench) else None)
    assert isinstance(bench.ask(request), Reply)


@pytest.mark.parametrize("make", BENCHES)
def test_image_of_another_product_stays_in_the_boot_loader(make: Callable[[], Bench]) -> None:
    """The command rejects such an image by its name. A device that has it anyway accepts another update."""
    bench = make()
    update(bench, FirmwareImage(APPLICATION, make_image("CH020", NEW, bench.size)))
    assert bench.version() == 0
    update(bench)
    assert bench.version() == NEW


@pytest.mark.parametrize(
    ("make", "address", "size", "words"),
    [
        (
            UartBench,
            FLASH_START - 2048,
            4096,
            "expected addresses in the flash memory 0x08000000 … 0x0807ffff, got 0x07",
        ),
        (UartBench, FLASH_START + FLASH_BYTES - 2048, 4096, "got 0x0807f800 … 0x080807ff"),
        (UartBench, APPLICATION + 4, 4096, "expected an image at a multiple of 2048 bytes, got 0x08010004"),
        (CanUpdateBench, 0x2000_0000, 64, "or 0x08000000 … 0x080fffff, got 0x20000000"),
        (CanUpdateBench, 0x0007_0000, 1 << 20, "0x00000000 … 0x000fffff or"),
    ],
)
def test_image_outside_the_flash_erases_nothing(make: Any, address: int, size: int, words: str) -> None:
    bench = make()
    before = bench.version()
    with pytest.raises(BadArgument, match=words.replace("…", ".")):
        update(bench, FirmwareImage(address, bytes(size)))
    assert bench.module.memory.erased == 0
    assert bench.version() == before


@pytest.mark.parametrize(
    ("make", "address", "size", "error"),
    [(UartBench, FLASH_START, 4096, Rejected), (CanUpdateBench, APPLICATION, FLASH_BYTES, Rejected)],
)
def test_boot_loader_that_rejects_the_image_erases_nothing(make: Any, address: int, size: int, error: type) -> None:
    bench = make()
    with pytest.raises(error):
        update(bench, FirmwareImage(address, bytes(size)))
    assert bench.module.memory.erased == 0


@pytest.mark.parametrize(("make", "code"), [(UartBench, "got 10200"), (CanUpdateBench, "0x06070012")])
def test_refused_erase_starts_the_application_again(make: Any, code: str) -> None:
    bench = make()
    before = bench.version()
    bench.module.memory.fault = LoaderFault.REFUSES_ERASE
    with pytest.raises(EraseRefused, match=code):
        update(bench)
    assert bench.module.memory.erased == 0
    assert bench.version() == before


@pytest.mark.parametrize("make", BENCHES)
def test_erase_refused_after_lost_transfer(make: Callable[[], Bench]) -> None:
    """The first transfer has erased the flash memory: the refusal of the second erase must not end as unchanged."""
    bench = make()
    update(bench)
    step = next(number for number, name in enumerate(bench.faults.steps, 1) if "data at" in name or "segment" in name)
    bench = make()
    erase = bench.module.memory.erase

    def erase_once() -> None:
        erase()
        bench.module.memory.fault = LoaderFault.REFUSES_ERASE

    bench.module.memory.erase = erase_once  # type: ignore[method-assign]
    with pytest.raises(Rejected) as caught:
        update(bench, plan={step: "lost reply"})
    assert not isinstance(caught.value, EraseRefused)
    assert bench.module.memory.erased == 1


def test_final_status_next_to_last_acknowledgement() -> None:
    bench = UartBench()
    bench.module.memory.fault = LoaderFault.REFUSES_DATA
    with pytest.raises(Rejected, match="end of the data: expected status 0, got 10203"):
        update(bench)
    assert "boot loader, reset" not in bench.faults.steps


def test_final_status_costs_no_wait() -> None:
    bench = UartBench()
    update(bench)
    steps = bench.faults.steps
    assert steps[-2:] == ["boot loader, data at 768", "boot loader, reset"]
    assert bench.durations_ns[-2] < 100_000_000


@pytest.mark.parametrize(
    ("make", "code"), [(UartBench, "reset: expected status 0, got 10101"), (CanUpdateBench, "0x08000022")]
)
def test_refused_start_is_an_error(make: Any, code: str) -> None:
    bench = make()
    bench.module.memory.fault = LoaderFault.REFUSES_START
    with pytest.raises(Rejected, match=code):
        update(bench)


@pytest.mark.parametrize("make", BENCHES)
def test_device_without_a_reply_ends_the_update(make: Callable[[], Bench]) -> None:
    bench = make()
    with pytest.raises(LostContact):
        update(bench, plan=dict.fromkeys(range(1, 1000), "lost reply"))
    assert bench.faults.step < 200


# --- product ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "device", "stated", "words"),
    [
        (b"..HI14R3\0", "HI14R3", "", ""),
        (b"..HI14\0", "HI14R3", "", ""),
        (b"..HI14R3\0", "HI14", "", ""),
        (b"..HI14R2\0", "HI14R3", "", "expected an image for HI14R3, got an image that names HI14R2"),
        (b"..CH020\0", "HI14R3", "HI14R3", "got an image that names CH020"),
        (b"..CH020 HI14\0", "HI14R3", "", ""),
        (b"XHI14R3 HI14R33", "HI14R3", "", "names no product"),
        (b"", "HI14R3", "", "add --product HI14R3"),
        (b"", "HI14R3", "hi14r3", ""),
        (b"", "HI14R3", "CH020", "got an image for CH020 according to --product"),
        (b"..HI14R3\0", "", "", "for example --product HI14R3"),
        (b"..HI14R3\0", "", "HI14R3", ""),
        (b"..HI14R3\0", "", "CH104", "got an image that names HI14R3"),
    ],
)
def test_product_of_an_image(content: bytes, device: str, stated: str, words: str) -> None:
    image = FirmwareImage(APPLICATION, content)
    if not words:
        check_product(image, device, stated)
        return
    with pytest.raises(BadArgument, match=words):
        check_product(image, device, stated)


# --- packets ---------------------------------------------------------------------------------------------------------


def test_golden_packets() -> None:
    """CRC-16/XMODEM by hand: the value of `123456789` is 0x31C3, and get-property 0x0B is a frame of NXP's manual."""
    assert kboot.ping().payload == bytes.fromhex("5aa6")
    assert kboot.packet(kboot.DATA, b"")[:4] == bytes.fromhex("5aa50000")
    asked = kboot.command(kboot.TAG_PROPERTY, 0x0B, 0)
    assert asked[:4] == bytes.fromhex("5aa40c00")
    assert asked[6:] == bytes.fromhex("07000002 0b000000 00000000".replace(" ", ""))
    crc = 0
    for byte in asked[:4] + asked[6:]:  # bit by bit
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    assert asked[4:6] == crc.to_bytes(2, "little")


REPLIES = (
    b"\x5a\xa1",
    b"\x5a\xa2",
    b"\x5a\xa3",
    kboot.ping_reply(),
    kboot.command(0xA0, 0, 2),
    kboot.command(0xA7, 0, 9),
)


@given(st.lists(st.sampled_from(REPLIES) | st.binary(max_size=9), max_size=8), st.data())
def test_replies_do_not_depend_on_the_split(parts: list[bytes], data: st.DataObject) -> None:
    stream = b"".join(parts)
    whole = kboot.KbootCodec(Ledger())
    expected = [*whole.feed(stream), *whole.flush()]
    split = kboot.KbootCodec(Ledger())
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=4)))
    found = [event for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True) for event in split.feed(stream[a:b])]
    assert [*found, *split.flush()] == expected
    assert split.ledger.snapshot() == whole.ledger.snapshot()
    assert split.ledger.closes()
    assert split.ledger.bytes_pending == 0
    assert split.ledger.bytes_in == len(stream)


def test_damaged_packet_counts_as_bad_and_the_next_reply_is_found() -> None:
    codec = kboot.KbootCodec(Ledger())
    reply = kboot.command(0xA0, 0, 2)
    damaged = reply[:-1] + b"\x01"
    events = codec.feed(damaged + b"\x5a\xa1xy")
    assert [type(event) for event in events] == [BadFrame, ReplyFrame]
    counts = codec.ledger
    assert (counts.bytes_in_bad_frames, counts.bytes_in_good_frames, counts.bytes_skipped) == (len(reply), 2, 2)
    assert (counts.frames_bad_crc, counts.frames_in_replies) == (1, 1)
    assert struct.calcsize("<BBHH") == kboot.HEADER.size


def test_both_drivers_have_an_update() -> None:
    assert (UART.firmware, CANOPEN.firmware) == (ON_UART, ON_CAN)
