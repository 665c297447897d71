"""Table of words of the Forsense IMU61x on SPI: how registers are written and read. Manual, sections 2.3 and 2.4.

Words of 16 bits, high byte first: bit 15 set writes the byte in bits 7-0 to the address in bits 14-8, bit 15 clear
reads the word at that address. The answer to a word comes with the second word after it:

    MOSI   word 1   word 2   word 3   word 4   …        chip select is released after every word
    MISO    any      any     answer 1 answer 2 …

Between the words of a message chip select is released for GAP_US (assumed; the manual draws one word per selection and
says nothing of the pause).
"""

import struct
from typing import Final

from imud.contracts.polling import Transfer
from imud.devices.imu61x.common.registers import BURST_CTRL, FILTER_CTRL, PROD_ID, WIN_CTRL

PIPELINE_WORDS: Final = 2
PIPELINE_BYTES: Final = 2 * PIPELINE_WORDS
GAP_US: Final = 10


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
    OPEN,
    *(read(PROD_ID + 2 * n) for n in range(4)),
    read(FILTER_CTRL),
    read(BURST_CTRL),
    read(BURST_CTRL + 1),
    CLOSE,
    read(WIN_CTRL),
)
"""Identity and settings in one message, both halves of BURST_CTRL, and the window after it was closed."""
