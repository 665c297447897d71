"""Transfer scripts of the Forsense IMU61x on SPI: identity, filters, kind of burst. Manual, chapter 2.

WIN_CTRL is 0 outside of this file's messages: a message that opens window 1 closes it again, and one that fails is
followed by one that closes it. How words are written and read is in `words.py`.

BURST_CTRL is the pair 0x0D, 0x0C (table 16): its high byte is written at 0x0D. The manual's layout has it read back in
the word at 0x0C, the vendor's program in that at 0x0D: both are read, either is accepted, and a burst of the right kind
decides.
"""

from collections.abc import Mapping
from typing import Final, Literal

from imud.contracts.driver import Identity
from imud.contracts.polling import Transfer, TransferScript
from imud.devices.imu61x.common.register_driver import (
    RegisterSettings,
    check_filter,
    filter_words,
    identity_of,
    wanted_filter,
)
from imud.devices.imu61x.common.registers import BURST_CTRL, FILTER_CTRL
from imud.devices.imu61x.spi.bursts import BURSTS, BurstKind, burst_problem
from imud.devices.imu61x.spi.words import CLOSE, CLOSE_ONLY, OPEN, READ_STATE, answers, message, write
from imud.errors import DeviceRefused, TransferError

MODES: Final = (0, 3)
"""The manual's, and the one of the vendor's own program: both sample on the rising edge."""
WINDOW_ID: Final = 0x01
"""The bit of WIN_CTRL in which the two codes of table 24 differ; no other is defined."""
BURST_TRIES: Final = 3
"""One damaged burst, or one write that was lost, is no refusal."""


class SpiDeviceSettings(RegisterSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of an IMU61x on SPI."""

    burst: Literal["standard", "extended", "registers"] = "standard"
    """Kind of read: the standard burst; the extended burst, which has temperature and angles; or single registers."""
    checksum_bits: Literal[16, 32] = 32
    """Checksum of the standard burst: all 32 bits, or only the 16 that the manual has."""


# --- state -----------------------------------------------------------------------------------------------------------


class State:
    """State as READ_STATE reads it. Missing bytes count as zeros."""

    def __init__(self, data: bytes) -> None:
        _, *words, _, window = (*answers(data), *(0,) * 10)[:10]
        self.product_id = b"".join(word.to_bytes(2, "big") for word in words[:4])
        self.filter = words[4] & 0xFF
        self.burst_ctrl = (words[5], words[6])
        """The words at 0x0C and 0x0D."""
        self.window = window & WINDOW_ID

    def differences(self, settings: SpiDeviceSettings) -> str:
        """Compare filter and window with the settings; an empty string if all agrees. Bursts show by themselves."""
        wanted = wanted_filter(settings, self.filter)
        if self.filter != wanted:
            return f"FILTER_CTRL is {self.filter:#04x}, expected {wanted:#04x}"
        return f"WIN_CTRL is {self.window}, expected 0" if self.window else ""

    @property
    def kind(self) -> BurstKind:
        """The kind of burst by BURST_CTRL: extended if any of the places where it may be read says so."""
        halves = {byte for word in self.burst_ctrl for byte in word.to_bytes(2, "big")}
        return "extended" if 1 in halves else "standard"


# --- scripts ---------------------------------------------------------------------------------------------------------


def probe(_settings: SpiDeviceSettings) -> TransferScript[Identity]:
    """Read PROD_ID1 … 4, and close the window in any case. Raises DeviceRefused for anything but an IMU61x."""
    return identity_of((yield from read_state()).product_id)


def set_up(settings: SpiDeviceSettings) -> TransferScript[Mapping[str, str]]:
    """Write FILTER_CTRL and BURST_CTRL where they differ and read back. Raises DeviceRefused if they differ still.

    Where BURST_CTRL reads back is not certain, so a burst itself decides which kind is selected.
    """
    state = yield from read_state()
    wanted = wanted_filter(settings, state.filter)
    if state.filter != wanted:
        yield from write_control(wanted)
    if state.window:
        yield CLOSE_ONLY
    if settings.burst != "registers":
        yield from _select(settings.burst, state, settings.checksum_bits)
    return {**filter_words(wanted), "burst": state.kind if settings.burst == "registers" else settings.burst}


def read_state() -> TransferScript[State]:
    """Read identity and settings."""
    return State((yield from _in_window_1(READ_STATE)))


def read_control() -> TransferScript[int]:
    """Read FILTER_CTRL."""
    return (yield from read_state()).filter


def write_control(control: int) -> TransferScript[None]:
    """Write FILTER_CTRL and read it back. Raises DeviceRefused if it is not the value written."""
    yield from _in_window_1(message(OPEN, write(FILTER_CTRL, control), CLOSE))
    check_filter(control, (yield from read_control()))


def _select(kind: BurstKind, state: State, checksum_bits: int) -> TransferScript[None]:
    """Select a kind of burst if it is not, until a burst is of that kind. Raises DeviceRefused."""
    why = ""
    for attempt in range(BURST_TRIES):
        if attempt or state.kind != kind:
            on = 1 if kind == "extended" else 0
            yield from _in_window_1(message(OPEN, write(BURST_CTRL + 1, on), CLOSE))
        why = burst_problem(kind, (yield BURSTS[kind]), checksum_bits)
        if not why:
            return
    low, high = (yield from read_state()).burst_ctrl
    raise DeviceRefused(
        f"expected a burst of kind {kind}, which was selected: {why}; BURST_CTRL reads {low:#06x} at 0x0C and "
        f"{high:#06x} at 0x0D; is the bus too fast?"
    )


def _in_window_1(transfer: Transfer) -> TransferScript[bytes]:
    """A message that opens and closes window 1; one that failed on its way may have left it open."""
    try:
        return (yield transfer)
    except TransferError:
        yield CLOSE_ONLY
        raise
