"""Zstandard frames (RFC 8878) with a known content size. The library is part of Python 3.14 and later versions."""

import sys

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd


class FrameEncoder:
    """Encoder of frames. Synchronization: one thread."""

    def __init__(self, level: int) -> None:
        self._compressor = zstd.ZstdCompressor(level)

    def encode(self, content: bytes) -> bytes:
        """Return the frame of a content. The frame states its content size."""
        return self._compressor.compress(content, zstd.ZstdCompressor.FLUSH_FRAME)


def content_size(frame: bytes) -> int:
    """Return the content size that a frame states, bytes. Raises ValueError if `frame` states none."""
    try:
        size = zstd.get_frame_info(frame).decompressed_size
    except zstd.ZstdError as error:
        raise ValueError(f"expected a Zstandard frame, got {len(frame)} other bytes") from error
    if size is None:
        raise ValueError("expected a Zstandard frame with its content size, got a frame without it")
    return size


def decode_frame(frame: bytes) -> bytes:
    """Return the content of exactly one frame. Its stated content size limits the memory: check `content_size` first.
    Raises ValueError."""
    size, decompressor = content_size(frame), zstd.ZstdDecompressor()
    try:
        # the additional byte shows a content that is longer than stated
        content = decompressor.decompress(frame, max_length=size + 1)
    except zstd.ZstdError as error:
        raise ValueError(f"expected a valid Zstandard frame, got {error}") from error
    if len(content) != size or not decompressor.eof or decompressor.unused_data:
        raise ValueError(f"expected one Zstandard frame of {size} bytes, got {len(content)} bytes or more data")
    return content
