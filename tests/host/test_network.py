"""Sockets of outputs on a kernel without IPv6, and name servers that do not reply."""

import asyncio
import errno
import os
import socket
import ssl
import subprocess
import sys
import threading
from ipaddress import IPv4Address, IPv4Network
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock

import pytest

from imud.host.network import CA_BYTES_MAX, interface_addresses, listen, resolve, tls_context
from imud.host.scrape_server import HttpRequest, HttpResponse, ScrapeServer
from imud.model.errors import ServerError
from imud.publishers.sentence_ports import TcpOutput, UdpOutput
from imud.utc.receivers import RmcOptions, SourceContext, make_gpsd
from tests.support.daemon_process import LIMIT_S
from tests.support.event_loops import VirtualClock, in_loop


@in_loop
async def test_a_kernel_without_ipv6(monkeypatch: pytest.MonkeyPatch) -> None:
    def make(family: int, kind: int) -> socket.socket:
        if family == socket.AF_INET6:
            raise OSError(errno.EAFNOSUPPORT, "Address family not supported by protocol")
        return real(family, kind)

    async def answer(_request: HttpRequest) -> HttpResponse:
        raise AssertionError

    real = socket.socket
    monkeypatch.setattr(socket, "socket", make)
    made = UdpOutput("::1", 9)
    made.put(b"$HEHDT,98.3,T*2F\r\n")
    assert (made.status().dropped, made.status().readers) == (1, 0)
    assert "not supported" in made.status().problem
    made.close()
    with pytest.raises(ServerError, match="::1 port 0: Address family not supported by protocol"):
        TcpOutput("::1", 0, VirtualClock().now_ns).open()
    with pytest.raises(ServerError, match="::1 port 0: Address family not supported by protocol"):
        ScrapeServer("::1", 0).start(answer)


def test_a_server_socket_does_not_block_and_its_port_is_in_use() -> None:
    with listen("127.0.0.1", 0) as listener:
        options = [listener.getsockopt(socket.SOL_SOCKET, one) for one in (socket.SO_REUSEADDR, socket.SO_ACCEPTCONN)]
        assert (listener.getblocking(), options) == (False, [1, 1])
        with pytest.raises(OSError, match="in use"):
            listen("127.0.0.1", listener.getsockname()[1])


@in_loop
async def test_a_name_server_is_silent(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """The event loop's executor delays the end of the process until its threads end."""
    release = threading.Event()
    threads: list[threading.Thread] = []

    def silent(*_arguments: Any, **_names: Any) -> Any:
        threads.append(threading.current_thread())
        release.wait(LIMIT_S)  # a failed assertion must not wait without a limit
        raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")

    monkeypatch.setattr(socket, "getaddrinfo", silent)
    context = cast(SourceContext, Mock(cpu_ns=int, now_ns=int))
    source = make_gpsd(RmcOptions(source="gpsd", host="gps.example"), context)
    source.start(lambda _sentence, _t_rx_ns: None)
    given_up, waiting = (asyncio.create_task(resolve("gps.example", 2947)) for _ in range(2))
    while len(threads) < 3:
        await asyncio.sleep(0)
    assert all(thread.daemon for thread in threads)
    await asyncio.get_running_loop().run_in_executor(None, int)  # no thread of the executor waits
    source.close()
    given_up.cancel()
    release.set()
    with pytest.raises(socket.gaierror, match="Temporary failure"):
        await waiting
    for thread in threads:
        thread.join()
    assert not caplog.records  # imud ignores the reply to a cancelled request


@in_loop
async def test_addresses_of_a_name() -> None:
    assert await resolve("127.0.0.1", 1) == ["127.0.0.1"]
    with pytest.raises(OSError, match="label"):
        await resolve("a" * 64 + ".example", 1)


def test_addresses_of_interfaces() -> None:
    """127.0.0.1 with its network is an address of each host."""
    addresses = interface_addresses()
    (loopback,) = [address for address in addresses if address.address == "127.0.0.1"]
    assert (loopback.network, loopback.is_loopback) == (IPv4Network("127.0.0.0/8"), True)
    assert socket.if_indextoname(loopback.interface_index) == "lo"
    assert all(IPv4Address(address.address) in address.network for address in addresses)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root for a network of its own")
def test_several_addresses_of_an_interface() -> None:
    """Secondary addresses have their own networks. The label of an old alias is `lo:1`. Interfaces that are down have
    no usable address."""
    setup = (
        "ip link set lo up; ip addr add 192.0.2.5/24 dev lo; ip addr add 198.51.100.1/32 dev lo label lo:1;"
        "ip link add dummy0 type dummy 2>/dev/null && ip addr add 203.0.113.1/24 dev dummy0;"
    )
    program = "from imud.host.network import interface_addresses as f; print([str(a.network) for a in f()])"
    command = ["unshare", "-n", "sh", "-c", f'{setup} exec "$0" -c "$1"', sys.executable, program]
    output = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    if output.returncode:
        pytest.skip(f"cannot create a network: {output.stderr.strip()}")
    assert output.stdout.strip() == "['127.0.0.0/8', '192.0.2.0/24', '198.51.100.1/32']"


def test_certificates_of_authorities_without_a_regular_file(tmp_path: Path) -> None:
    """OpenSSL would wait for the FIFO. Python would trust the authorities of the system instead of an empty file."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    with pytest.raises(OSError, match=f"cannot read ca_file {fifo}: is a FIFO, expected a regular file"):
        tls_context(str(fifo))
    empty = tmp_path / "empty"
    damaged = b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"
    for content in (b"", b"\n", b"text", damaged):
        empty.write_bytes(content)
        with pytest.raises(ssl.SSLError, match=rf"ca_file {empty}: expected certificates \(PEM\)"):
            tls_context(str(empty))
    empty.write_bytes(bytes(CA_BYTES_MAX + 1))
    with pytest.raises(OSError, match="expected at most 1048576 bytes"):
        tls_context(str(empty))


def test_comments_between_certificates(tmp_path: Path) -> None:
    bundle = ssl.get_default_verify_paths().cafile or "/etc/ssl/certs/ca-certificates.crt"
    if not Path(bundle).exists():
        pytest.skip("this host has no bundle of certificates (ca-certificates)")
    file = tmp_path / "ca.pem"
    file.write_bytes("# Főtanúsítvány\n".encode() + Path(bundle).read_bytes())
    expected = ssl.create_default_context(cafile=bundle)
    assert tls_context(str(file)).cert_store_stats() == expected.cert_store_stats()
