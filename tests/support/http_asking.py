"""Talks HTTP to a server under test."""

import asyncio
import socket

LIMIT_S = 5.0


async def ask(port: int, path: str = "/metrics", method: str = "GET", headers: str = "") -> tuple[str, str, str]:
    """Status line, head and body of one answer, until the server ends the connection."""
    async with asyncio.timeout(LIMIT_S):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(f"{method} {path} HTTP/1.1\r\nHost: x\r\n{headers}\r\n".encode())
        answer = (await reader.read()).decode()
        writer.close()
        await writer.wait_closed()
    head, _, body = answer.partition("\r\n\r\n")
    return head.partition("\r\n")[0], head, body


def read_all(connection: socket.socket) -> bytes:
    """Until the far end closes; a connection reset counts as closed."""
    parts = []
    try:
        while part := connection.recv(65536):
            parts.append(part)
    except ConnectionResetError:
        pass
    return b"".join(parts)
