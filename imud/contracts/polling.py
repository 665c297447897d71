"""Contract of a polled device: transfers out, bytes in, no I/O. The host decides when to read, on I2C, SPI or RS-485.

An exchange of several transfers (identify, set a filter) is a generator, a `TransferScript`: it yields a `Transfer` and
is sent the bytes read or thrown the `TransferError`. Cyclic reads are `Poll`s, whose bytes go to a `PolledCodec`. The
daemon's bus threads and tests run the same generators and codecs.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from random import Random
from typing import Any, Protocol, TypeVar

import msgspec

from imud.contracts.codec import CodecEvent
from imud.contracts.driver import SAMPLE_COUNTER, Driver, Identity
from imud.errors import TransferError
from imud.ledger import Ledger

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Transfer:
    """One transaction, done by one system call."""

    sends: tuple[bytes, ...]
    """SPI: the bytes of each assertion of chip select, of which as many are read. I2C: one item, written first."""
    read_bytes: int = 0
    """I2C: number of bytes to read after a repeated start; 0 for a write alone."""
    gap_us: int = 0
    """SPI: pause after each assertion of chip select."""
    at: int | None = None
    """I2C, RS-485: address of this transfer alone, for example to see whether another device has it."""
    then_at: int | None = None
    """I2C, RS-485: the device's address after this transfer, whatever came of it, and also when the script has ended.
    A script that does not find the device there goes back: a transfer with the former address as `at` and `then_at`."""
    holds: bool = False
    """Whether the device is not read between this transfer and the script's next one: it may be elsewhere just then."""
    reply_ms: int = 0
    """RS-485: longest time to the beginning of the reply; 0, or less than that of the link, for that of the link."""


TransferScript = Generator[Transfer, bytes, T]
"""A script of transfers. It may catch TransferError to clean up; DeviceRefused passes through it."""


@dataclass(frozen=True, slots=True)
class Poll:
    """A transfer that is repeated."""

    transfer: Transfer
    every_ns: int = 0
    """0 for at every deadline of the device, otherwise at the first deadline after so much time."""


class Reading(msgspec.Struct, frozen=True, gc=False):
    """The result of one poll."""

    poll: int
    """Index of the poll in the codec's `polls`."""
    data: bytes
    """All bytes read, in their order; empty if the transfer failed."""
    error: TransferError | None
    start_ns: int
    """CLOCK_MONOTONIC right before the transfer."""
    end_ns: int
    """CLOCK_MONOTONIC right after it."""


class Vanished(msgspec.Struct, frozen=True):
    """Evidence that the device is absent or has lost its settings: it must be identified again."""

    why: str


PolledEvent = CodecEvent | Vanished


class PolledCodec(Protocol):
    """Decoder of the results of polls. Synchronization: one thread."""

    ledger: Ledger
    polls: Sequence[Poll]
    """Cyclic reads; the first makes the samples."""

    @property
    def stale(self) -> int:
        """Frames that were the same as the one before: the device had nothing new."""
        ...

    def decode(self, poll: int, data: bytes) -> Sequence[PolledEvent]:
        """Decode the bytes of one transfer. Never raises for any bytes, of any length."""
        ...

    def on_silence(self, poll: int) -> Sequence[PolledEvent]:
        """Process a poll whose transfer failed; return what follows from it. Most codecs have nothing to do."""
        ...

    def reset(self) -> None:
        """Forget the last frame, with which the next one is compared: the device was identified anew."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PolledDriver(Driver):
    """A device that sends only on request, without time or messages: its samples are dated by the host's deadlines."""

    tick_ns: int = SAMPLE_COUNTER
    tick_modulus: int = 2
    link: str
    """Name of the link it hangs on, a row of LINKS."""
    targets: tuple[int, ...]
    """Values to try when the link says `auto`, most likely first: I2C addresses, SPI modes."""
    probe: Callable[[Any], TransferScript[Identity]]
    """Reads the identity of a device with these settings. Raises DeviceRefused for another device. Changes nothing."""
    set_up: Callable[[Any], TransferScript[Mapping[str, str]]]
    """Writes the settings to the device, reads them back, returns them by the device's names. Raises DeviceRefused."""
    make_codec: Callable[[Ledger, Any], PolledCodec]
    """Makes a codec that counts into the ledger, from an instance of `settings`."""
    update_ns: Callable[[Any], int]
    """Longest time between two updates of the device's registers, from the settings; 0 for not known."""
    example_reading: Callable[[Random], bytes]
    """Bytes of the first poll with random values, for the shared property tests and for fault injection."""
    read_ns: Callable[[Any, Any], int] = lambda _options, _link: 0
    """Shortest time that one read of the samples takes on the bus, ns, from instances of `settings` and of the link's
    settings; 0 for not known. The sum over the devices of a bus decides whether it carries their rates."""


def run_transfer_script(script: TransferScript[T], transfer: Callable[[Transfer], bytes]) -> T:
    """Run a script to its end and return its result. Raises what it raises, and LinkError from `transfer`."""
    try:
        wanted = next(script)
        while True:
            wanted = step(script, wanted, transfer)
    except StopIteration as end:
        value: T = end.value
        return value


def step(script: TransferScript[Any], wanted: Transfer, transfer: Callable[[Transfer], bytes]) -> Transfer:
    """Make the wanted transfer and return the next one. Raises StopIteration with the value at the end."""
    try:
        data = transfer(wanted)
    except TransferError as error:
        return script.throw(error)
    return script.send(data)
