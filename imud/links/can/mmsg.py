"""Several datagrams in one system call: the kernel's structures, and frames sent so (sendmmsg(2), recvmmsg(2))."""

import ctypes
import errno
import os
from collections.abc import Sequence
from typing import Final

libc: Final = ctypes.CDLL(None, use_errno=True)


class Header(ctypes.Structure):
    """`struct msghdr`."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_bytes", ctypes.c_uint32),
        ("vector", ctypes.c_void_p),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_bytes", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class MessageBuffers(ctypes.Structure):
    """`struct mmsghdr`."""

    _fields_ = (("header", Header), ("received_bytes", ctypes.c_uint))


class Vector(ctypes.Structure):
    """`struct iovec`."""

    _fields_ = (("base", ctypes.c_void_p), ("bytes", ctypes.c_size_t))


def send_all(fd: int, datagrams: Sequence[bytes]) -> list[OSError]:
    """Send the datagrams in order, in one system call if all are taken; return an error for each that was not.

    Nobody can come between two of them unless one is refused, and a stall of this process cannot tear them apart.
    """
    count = len(datagrams)
    if not count:
        return []
    content = ctypes.create_string_buffer(b"".join(datagrams))
    vectors, messages, base = (Vector * count)(), (MessageBuffers * count)(), ctypes.addressof(content)
    for vector, message, data in zip(vectors, messages, datagrams, strict=True):
        vector.base, vector.bytes = base, len(data)
        base += len(data)
        message.header.vector, message.header.vector_count = ctypes.addressof(vector), 1
    refused, at, size = list[OSError](), 0, ctypes.sizeof(MessageBuffers)
    while at < count:
        sent = libc.sendmmsg(fd, ctypes.byref(messages, at * size), count - at, 0)
        number = ctypes.get_errno()
        if sent < 0 and number == errno.EINTR:
            continue
        if sent <= 0:
            refused.append(OSError(number, os.strerror(number)))
        at += max(sent, 1)
    return refused
