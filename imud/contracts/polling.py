"""What a polled device is: transfers out, bytes in, no I/O. The host decides when to ask, on I2C, SPI or a shared line.

What needs several transfers (who are you, set a filter) is a generator, a `TransferScript`: it yields a `Transfer`, and
is sent the bytes read or thrown the `TransferError`. What is read over and over is a `Poll`, whose bytes go to a
`PolledCodec`. The same generators and codecs are run by the daemon's bus threads and by tests.
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
    """I2C: so many bytes are read after a repeated start; 0 for a write alone."""
    gap_us: int = 0
    """SPI: pause after each assertion of chip select."""


TransferScript = Generator[Transfer, bytes, T]
"""A conversation by transfers. It may catch TransferError to clean up, and lets DeviceRefused out."""


@dataclass(frozen=True, slots=True)
class Poll:
    """A transfer that is made again and again."""

    transfer: Transfer
    every_ns: int = 0
    """0 for at every deadline of the device, otherwise at the first deadline after so much time."""


class Reading(msgspec.Struct, frozen=True, gc=False):
    """What came of one poll."""

    poll: int
    """Its index in the codec's `polls`."""
    data: bytes
    """All bytes read, in their order; empty if the transfer failed."""
    error: TransferError | None
    start_ns: int
    """CLOCK_MONOTONIC right before the transfer."""
    end_ns: int
    """CLOCK_MONOTONIC right after it."""


class Vanished(msgspec.Struct, frozen=True):
    """The bytes show that the device is gone, or is not as it was set up: it must be identified again."""

    why: str


PolledEvent = CodecEvent | Vanished


class PolledCodec(Protocol):
    """Turns what polls read into events. Synchronization: one thread."""

    ledger: Ledger
    polls: Sequence[Poll]
    """What to read; the first makes the samples."""

    @property
    def stale(self) -> int:
        """Frames that were the same as the one before: the device had nothing new."""
        ...

    def take(self, poll: int, data: bytes) -> Sequence[PolledEvent]:
        """Take the bytes of one transfer. Never raises for any bytes, of any length."""
        ...

    def reset(self) -> None:
        """The device was identified anew: the next frame is not compared with an earlier one."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PolledDriver(Driver):
    """A device that speaks only when it is asked. It sends no time and no messages: the host's deadlines date it."""

    tick_ns: int = SAMPLE_COUNTER
    tick_modulus: int = 2
    link: str
    """Name of the link it hangs on, a row of LINKS."""
    targets: tuple[int, ...]
    """Where to look for it when the link says `auto`, most likely first: I2C addresses, SPI modes."""
    probe: Callable[[Any], TransferScript[Identity]]
    """Asks the device what it is; given the settings. Raises DeviceRefused for another device. Changes nothing."""
    set_up: Callable[[Any], TransferScript[Mapping[str, str]]]
    """Makes the device what the settings say, reads back, returns its settings by its own names; DeviceRefused."""
    make_codec: Callable[[Ledger, Any], PolledCodec]
    """Makes a codec that counts into the ledger, from an instance of `settings`."""
    update_ns: Callable[[Any], int]
    """Longest time between two updates of the device's registers, from the settings; 0 for not known."""
    example_reading: Callable[[Random], bytes]
    """Bytes of the first poll with random values, for the shared property tests and for fault injection."""


def run_transfer_script(dialogue: TransferScript[T], transfer: Callable[[Transfer], bytes]) -> T:
    """Run a dialogue to its end. Raises what it raises, and LinkError from `transfer`."""
    try:
        wanted = next(dialogue)
        while True:
            wanted = step(dialogue, wanted, transfer)
    except StopIteration as end:
        value: T = end.value
        return value


def step(dialogue: TransferScript[Any], wanted: Transfer, transfer: Callable[[Transfer], bytes]) -> Transfer:
    """Make the wanted transfer and return the next one. Raises StopIteration with the value at the end."""
    try:
        data = transfer(wanted)
    except TransferError as error:
        return dialogue.throw(error)
    return dialogue.send(data)
