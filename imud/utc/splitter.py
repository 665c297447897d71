"""Finds RMC sentences in a stream of bytes that holds other sentences, JSON, or noise as well."""

from typing import Final

from imud.formats.rmc import SENTENCE_BYTES_MAX

LINE_BYTES_MAX: Final = 16384
"""Longer lines (gpsd writes JSON of some kilobytes) are passed over without being kept."""


class SentenceSplitter:
    """Bytes in any split in, RMC sentences out. Never holds more than LINE_BYTES_MAX. Synchronization: one thread."""

    def __init__(self) -> None:
        self._tail = b""
        self._skipping = False

    def feed(self, data: bytes) -> list[bytes]:
        """Sentences that are complete now, with CR LF; whether they are right is for `imud.formats.rmc` to say."""
        *lines, tail = (self._tail + data).split(b"\n")
        if lines and self._skipping:
            lines, self._skipping = lines[1:], False
        if len(tail) > LINE_BYTES_MAX:
            tail, self._skipping = b"", True
        self._tail = b"" if self._skipping else tail
        return [sentence for line in lines if (sentence := _rmc_in(line))]

    def clear(self) -> None:
        """The stream broke."""
        self._tail, self._skipping = b"", False


def _rmc_in(line: bytes) -> bytes | None:
    """The sentence that a line ends with: bytes lost before it may have joined it to another."""
    begin = line.rfind(b"$")
    sentence = line[begin:].rstrip(b"\r")
    if begin < 0 or sentence[3:7] != b"RMC," or len(sentence) > SENTENCE_BYTES_MAX - 2:
        return None
    return sentence + b"\r\n"
