"""All polled codecs and their scripts: for any bytes, a codec raises no exception and each script ends.

The first byte of an input selects the combination of options. With bit 7, the other bytes are the replies to `probe`
and `set_up`. Without bit 7, they are a list of readings: number of the poll, length, and bytes.
"""

from collections.abc import Sequence
from contextlib import suppress
from random import Random

from imud.contracts.driver import PolledDriver
from imud.contracts.script import Transfer, run_transfer_script
from imud.model.errors import DeviceRefused, TransferError, Trouble
from imud.model.ledger import Ledger
from imud.testing.invariants import check_closed, decode_polled
from tests.fuzz.drivers import EXAMPLES, mend_reading, names_of, row, variants
from tests.fuzz.target import FRAMES_BYTES_MAX, Target

CONVERSATION = 0x80  # bit of the first byte: replies to a script
FAILS = 0x40  # bit of a reply: the transfer fails
TRANSFERS_MAX = 20
"""Maximum number of transfers of a script, for any replies."""


def names() -> Sequence[str]:
    return names_of(PolledDriver)


def make(name: str) -> Target:
    driver = row(name, PolledDriver)
    choices = variants(driver.settings)

    def run(data: bytes) -> None:
        if not data:
            return
        settings = choices[data[0] % CONVERSATION % len(choices)]
        if data[0] & CONVERSATION:
            _converse(driver, settings, data[1:])
        else:
            _poll(driver, settings, data[1:])

    def mended(data: bytes, random: Random) -> bytes:
        if not data or data[0] & CONVERSATION:
            return data
        readings = _readings(data[1:])
        if not readings:
            return data
        at = random.randrange(len(readings))
        poll, reading = readings[at]
        if random.random() < 0.3:
            reading = driver.example_reading(random)
        readings[at] = (poll, mend_reading(name, reading))
        return data[:1] + b"".join(_record(*each) for each in readings)

    return Target(run, lambda: _seeds(driver, len(choices)), mended, bytes_max=FRAMES_BYTES_MAX)


def _poll(driver: PolledDriver, settings: object, data: bytes) -> None:
    codec = driver.make_codec(Ledger(), settings)
    stale = 0
    for poll, reading in _readings(data):
        decode_polled(codec, poll % len(codec.polls), reading)
        assert codec.stale >= stale
        stale = codec.stale
    codec.reset()
    check_closed(codec.ledger)


def _converse(driver: PolledDriver, settings: object, data: bytes) -> None:
    answers = iter(_readings(data))
    transfers = 0

    def transfer(wanted: Transfer) -> bytes:
        nonlocal transfers
        transfers += 1
        assert transfers <= TRANSFERS_MAX
        kind, answer = next(answers, (FAILS, b""))
        if kind & FAILS:
            raise TransferError(Trouble.DISTURBED, "by the fuzzer")
        size = wanted.read_bytes or sum(map(len, wanted.sends))
        return answer[:size].ljust(size, b"\0") if kind & 1 else answer

    for script in (driver.probe(settings), driver.set_up(settings)):
        transfers = 0
        with suppress(TransferError, DeviceRefused):
            run_transfer_script(script, transfer)


def _readings(data: bytes) -> list[tuple[int, bytes]]:
    found: list[tuple[int, bytes]] = []
    at = 0
    while at + 2 <= len(data):
        begin, end = at + 2, at + 2 + data[at + 1]
        found.append((data[at], data[begin:end]))
        at = end
    return found


def _record(poll: int, reading: bytes) -> bytes:
    return bytes([poll, min(len(reading), 255)]) + reading[:255]


def _seeds(driver: PolledDriver, count: int) -> list[bytes]:
    random = Random(1)
    readings = [_record(0, driver.example_reading(random)) for _ in range(EXAMPLES)]
    seeds = [b"\0" + reading for reading in readings]
    for variant in range(count):
        codec = driver.make_codec(Ledger(), variants(driver.settings)[variant])
        sizes = [poll.transfer.read_bytes or sum(map(len, poll.transfer.sends)) for poll in codec.polls]
        polls = [_record(poll, random.randbytes(size)) for poll, size in enumerate(sizes)]
        seeds += [bytes([variant]) + b"".join(polls), bytes([variant]) + readings[0] + b"".join(polls) + readings[0]]
        seeds.append(bytes([variant | CONVERSATION]) + b"".join(_record(1, random.randbytes(20)) for _ in range(6)))
    return [
        *seeds, b"\0" + b"".join(readings[:3]), b"\0\0\0", b"\0" + _record(0, bytes(30)),
        b"\x80" + _record(FAILS, b""),
    ]  # fmt: skip
