"""Frames of Zstandard: the library `zstandard` reads and writes them independently."""

import pytest
import zstandard

from imud.formats.zstandard import FrameEncoder, content_size, decode_frame

CONTENT = b"abcd" * 1000


def test_another_implementation_reads_and_writes_the_frames() -> None:
    encoder = FrameEncoder(3)
    for content in (CONTENT, b"", bytes(range(256)), CONTENT):
        frame = encoder.encode(content)
        assert zstandard.frame_content_size(frame) == content_size(frame) == len(content)
        assert zstandard.ZstdDecompressor().decompress(frame) == content
        assert decode_frame(zstandard.ZstdCompressor().compress(content)) == content


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (b"x" * 40, "expected a Zstandard frame, got 40 other bytes"),
        (b"", "expected a Zstandard frame, got 0 other bytes"),
        (zstandard.ZstdCompressor(write_content_size=False).compress(CONTENT), "with its content size"),
        (zstandard.compress(CONTENT)[:-3], "expected one Zstandard frame of 4000 bytes, got"),
        (zstandard.compress(CONTENT) + b"a", "expected one Zstandard frame of 4000 bytes, got 4000 bytes or more"),
        (zstandard.compress(CONTENT)[:-4] + b"\xff\xff\xff\xff", "expected a valid Zstandard frame, got"),
    ],
)
def test_a_damaged_frame_is_an_error(frame: bytes, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        decode_frame(frame)
