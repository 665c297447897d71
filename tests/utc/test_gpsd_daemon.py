"""A real daemon that feeds a device with the sentences that a real gpsd receives on a pseudo-terminal."""

import os
import select
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from imud.formats.nmea0183 import Rmc, build, checksum, parse
from imud.model.units import NS_PER_S
from tests.support.daemon_process import LIMIT_S, running_daemon
from tests.support.pty_port import PtyPort
from tests.support.surroundings import free_port

WANTED = 3
UTC_S = 1_795_000_000
NO_GPSD = "" if shutil.which("gpsd") else "gpsd is not installed (Debian package gpsd)"


class Receiver(PtyPort):
    """A GNSS receiver with a fix, on a pty. It sends one cycle of sentences after the other."""

    def __init__(self) -> None:
        super().__init__()
        os.chmod(self.path, 0o666)  # gpsd drops its privileges
        self.second = UTC_S

    def cycle(self) -> None:
        rmc = build(self.second * NS_PER_S)
        time = rmc.split(b",")[1].decode()
        gga = f"GPGGA,{time},0000.000,N,00000.000,E,1,08,0.9,12.0,M,0.0,M,,"
        gsa = "GPGSA,A,3,01,02,03,04,05,06,07,08,,,,,1.6,0.9,1.3"
        rest = "".join(f"${body}*{checksum(body.encode()):02X}\r\n" for body in (gga, gsa))
        self.received()  # no reply to the requests of gpsd
        self.send(rmc + rest.encode())
        self.second += 1


@contextmanager
def gpsd(port: int, device: str, folder: Path) -> Iterator[None]:
    with (folder / "gpsd.log").open("w") as log:
        command = ["gpsd", "-N", "-n", "-b", "-D", "2", "-S", str(port), device]
        process = subprocess.Popen(command, stdout=log, stderr=log)
        try:
            yield
        finally:
            process.terminate()
            process.wait(timeout=LIMIT_S)
            print((folder / "gpsd.log").read_text())


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    made = Receiver()
    yield made
    made.unplug()


class Port(PtyPort):
    """The far end of a serial port, with a device that only receives."""

    text = b""

    def lines(self, wait_s: float) -> list[bytes]:
        select.select([self.master], [], [], wait_s)
        *whole, self.text = (self.text + self.received()).split(b"\n")
        return [line + b"\n" for line in whole]


@pytest.fixture
def port() -> Iterator[Port]:
    made = Port()
    yield made
    made.unplug()


@pytest.mark.live
@pytest.mark.skipif(bool(NO_GPSD), reason=NO_GPSD)
def test_a_device_gets_the_sentences_of_gpsd(receiver: Receiver, port: Port, tmp_path: Path) -> None:
    tcp_port = free_port()
    device = {
        "driver": "hipnuc-uart", "identify": False, "uart": {"port": port.path, "baud": 115200},
        "rmc": {"source": "gpsd", "tcp_port": tcp_port},
    }  # fmt: skip
    fed: list[Rmc] = []
    with gpsd(tcp_port, receiver.path, tmp_path), running_daemon(tmp_path, {"bow": device}) as daemon:
        receiver.second = 0
        end = time.monotonic() + LIMIT_S
        while len(fed) < WANTED:
            assert time.monotonic() < end, daemon.statuses()["bow"].utc
            now_s = time.time()
            if int(now_s) > receiver.second and now_s % 1 < 0.5:  # a receiver sends each sentence early in its second
                receiver.second = int(now_s)
                receiver.cycle()
                receiver.second -= 1
            for line in port.lines(0.1):
                assert line.startswith(b"$GPRMC,")
                rmc = parse(line)
                assert isinstance(rmc, Rmc)
                assert rmc.unix_s <= time.time()
                fed.append(rmc)
        utc = daemon.statuses()["bow"].utc
    assert all(rmc.valid and rmc.fraction_ns == 0 for rmc in fed)
    assert utc is not None
    assert (utc.source, utc.problem) == (f"gpsd at 127.0.0.1:{tcp_port}", "")
    assert utc.sentences >= utc.sent >= WANTED
