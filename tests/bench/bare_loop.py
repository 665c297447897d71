"""Minimal Python server, the reference for the cost of imud: epoll, read, find, CRC, unpack, pack, send.

The server has no clock, no ledger, no shared memory and no protection against slow clients. It prints `ready`. Then it
serves each connected client until SIGTERM: `python -m tests.bench.bare_loop SOCKET ENCODING HOLD_MS PTY…`.
"""

import binascii
import os
import select
import socket
import struct
import sys
import time
import tty

import msgspec

from imud.drivers.hipnuc.uart.codec import encode_hi91  # noqa: F401 - same start-up cost as imud
from imud.formats.slot import SLOT_BYTES
from tests.bench.readers import LENGTH

HEAD = struct.Struct("<2sHH")  # HiPNUC header: sync, length, CRC
BODY = struct.Struct("<BHbfI16f")  # payload of an HI91 frame
VALUES = "<IQqqqqQIIIHBx3d3d3d4d3d2d2d"  # length prefix and values of a slot of imud's binary encoding
OUT = struct.Struct(f"{VALUES}{LENGTH.size + SLOT_BYTES - struct.calcsize(VALUES)}x")
JSON = msgspec.json.Encoder()


def binary(device: int, seq: int, now_ns: int, v: tuple[float, ...]) -> bytes:
    return OUT.pack(SLOT_BYTES, seq, now_ns, now_ns, now_ns, 0, 0, 0, 0, 0, device, 0, *v[5:21], v[2], v[3], 0.0, 0.0)


def as_json(device: int, seq: int, now_ns: int, v: tuple[float, ...]) -> bytes:
    params = {"device": str(device), "seq": seq, "t_ns": now_ns, "accel": v[5:8], "gyro": v[8:11], "mag": v[11:14],
              "euler": v[14:17], "quat": v[17:21], "temperature": v[2], "pressure_pa": v[3]}  # fmt: skip
    return JSON.encode({"jsonrpc": "2.0", "method": "sample", "params": params}) + b"\n"


def serve(path: str, encoding: str, hold_s: float, ports: list[str]) -> None:
    pack = binary if encoding == "binary" else as_json
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(path)
    listener.listen(256)
    poll = select.epoll()
    poll.register(listener.fileno(), select.EPOLLIN)
    # incomplete frame at the end of each port's data
    tails: dict[int, bytes] = {}
    seqs: dict[int, int] = {}
    for port in ports:
        fd = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(fd)
        poll.register(fd, select.EPOLLIN)
        tails[fd], seqs[fd] = b"", 0
    clients: list[socket.socket] = []
    print("ready", flush=True)
    crc = binascii.crc_hqx
    while True:
        ready = poll.poll()
        # the reference for `latency_ms`: let the samples of several reads collect in the pty
        if hold_s:
            time.sleep(hold_s)
        for fd, _ in ready:
            if fd not in tails:
                clients.append(listener.accept()[0])
                continue
            data = tails[fd] + os.read(fd, 65536)
            out = []
            # sync bytes of HiPNUC; 82 bytes are an HI91 frame: 6 bytes of header, 76 of payload
            at = data.find(b"\x5a\xa5")
            while at >= 0 and len(data) - at >= 82:
                _, length, check = HEAD.unpack_from(data, at)
                if length == 76 and crc(data[at + 6 : at + 82], crc(data[at : at + 4], 0)) == check:
                    seqs[fd] += 1
                    out.append(pack(fd, seqs[fd], time.monotonic_ns(), BODY.unpack_from(data, at + 6)))
                    at = data.find(b"\x5a\xa5", at + 82)
                else:
                    at = data.find(b"\x5a\xa5", at + 2)
            tails[fd] = data[at:] if at >= 0 else b""
            message = b"".join(out)
            if message:
                for client in clients:
                    client.send(message)


if __name__ == "__main__":
    serve(sys.argv[1], sys.argv[2], float(sys.argv[3]) / 1e3, sys.argv[4:])
