"""Words and transfer scripts of the Forsense IMU61x on SPI: identity, filters, kind of burst. Manual, chapter 2.

Words of 16 bits, high byte first: bit 15 set writes the byte in bits 7-0 to the address in bits 14-8, bit 15 clear
reads the word at that address. The answer to a word comes with the second word after it:

    MOSI   word 1   word 2   word 3   word 4   …        chip select is released after every word
    MISO    any      any     answer 1 answer 2 …

WIN_CTRL is 0 outside of this file's messages: a message that opens window 1 closes it again, and one that fails is
followed by one that closes it. Between the words of a message chip select is released for GAP_US (assumed; the manual
draws one word per selection and says nothing of the pause).
"""

import struct
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
from imud.devices.imu61x.common.registers import BURST_CTRL, FILTER_CTRL, PROD_ID, WIN_CTRL
from imud.errors import DeviceRefused, TransferError

MODES: Final = (0, 3)
"""The manual's, and the one of the vendor's own program: both sample on the rising edge."""
PIPELINE_WORDS: Final = 2
PIPELINE_BYTES: Final = 2 * PIPELINE_WORDS
GAP_US: Final = 10


class SpiDeviceSettings(RegisterSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of an IMU61x on SPI."""

    burst: Literal["standard", "extended", "registers"] = "standard"
    """Kind of read: the standard burst; the extended burst, which has temperature and angles; or single registers."""
    checksum_bits: Literal[16, 32] = 32
    """Checksum of the standard burst: all 32 bits, or only the 16 that the manual has."""


# --- words -----------------------------------------------------------------------------------------------------------


def read(address: int) -> int:
    """The word that reads a register."""
    return address << 8


def write(address: int, value: int) -> int:
    """The word that writes one byte."""
    return 0x8000 | address << 8 | value


def message(*words: int) -> Transfer:
    """Words with chip select released between them, and two more for the answers to the last ones."""
    pipeline = (read(WIN_CTRL),) * PIPELINE_WORDS  # answers with the window, which must be 0 again by then
    return Transfer(tuple(word.to_bytes(2, "big") for word in (*words, *pipeline)), gap_us=GAP_US)


def answers(data: bytes) -> tuple[int, ...]:
    """The answer to each word of a message, without the two of the pipeline itself."""
    words = memoryview(data)[PIPELINE_BYTES:]
    return struct.unpack(f">{len(words) // 2}H", words[: len(words) // 2 * 2])


OPEN: Final = write(WIN_CTRL, 1)
CLOSE: Final = write(WIN_CTRL, 0)
CLOSE_ONLY: Final = message(CLOSE)
READ_STATE: Final = message(
    OPEN, *(read(PROD_ID + 2 * n) for n in range(4)), read(FILTER_CTRL), read(BURST_CTRL), CLOSE, read(WIN_CTRL)
)  # fmt: skip
"""Identity and settings in one message, and the window after it was closed."""
_EXTENDED_ON: Final = {"standard": 0, "extended": 1}


class State:
    """State as READ_STATE reads it. Missing bytes count as zeros."""

    def __init__(self, data: bytes) -> None:
        _, *words, _, self.window = (*answers(data), *(0,) * 9)[:9]
        self.product_id = b"".join(word.to_bytes(2, "big") for word in words[:4])
        self.filter = words[4] & 0xFF
        self.extended = words[5] >> 8

    def differences(self, settings: SpiDeviceSettings) -> str:
        """Compare the state with the settings; an empty string if all agrees."""
        wanted = wanted_filter(settings, self.filter)
        if self.filter != wanted:
            return f"FILTER_CTRL is {self.filter:#04x}, expected {wanted:#04x}"
        burst = _EXTENDED_ON.get(settings.burst, self.extended)
        if self.extended != burst:
            return f"BURST_CTRL is {self.extended}, expected {burst}"
        return f"WIN_CTRL is {self.window}, expected 0" if self.window else ""


# --- scripts ---------------------------------------------------------------------------------------------------------


def probe(_settings: SpiDeviceSettings) -> TransferScript[Identity]:
    """Read PROD_ID1 … 4, and close the window in any case. Raises DeviceRefused for anything but an IMU61x."""
    data = yield from _in_window_1(READ_STATE)
    return identity_of(State(data).product_id)


def set_up(settings: SpiDeviceSettings) -> TransferScript[Mapping[str, str]]:
    """Write FILTER_CTRL and BURST_CTRL where they differ, read them back. Raises DeviceRefused if they differ still."""
    state = State((yield from _in_window_1(READ_STATE)))
    wanted = wanted_filter(settings, state.filter)
    if state.differences(settings):
        extended = _EXTENDED_ON.get(settings.burst, state.extended)
        yield from _in_window_1(message(OPEN, write(FILTER_CTRL, wanted), write(BURST_CTRL + 1, extended), CLOSE))
        state = State((yield from _in_window_1(READ_STATE)))
        check_filter(wanted, state.filter)
        if why := state.differences(settings):
            raise DeviceRefused(f"{why} after it was written; is the bus too fast?")
    return {**filter_words(state.filter), "burst": "extended" if state.extended else "standard"}


def _in_window_1(transfer: Transfer) -> TransferScript[bytes]:
    """A message that opens and closes window 1; one that failed on its way may have left it open."""
    try:
        return (yield transfer)
    except TransferError:
        yield CLOSE_ONLY
        raise
