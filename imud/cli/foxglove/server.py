"""The WebSocket server of `imud foxglove`, by foxglove-sdk, behind its gate. It needs the extra `foxglove`."""

import secrets
from collections.abc import Callable
from ipaddress import IPv4Network
from typing import Any, Final

import foxglove
from foxglove.websocket import StatusLevel

from imud.bridges.channel import MessageChannel
from imud.cli.foxglove.gate import ViewerGate
from imud.cli.foxglove.origins import ViewerOrigins
from imud.errors import ServerError

STATUS_ID: Final = "daemon"
"""Of the status message that says why nothing comes."""
LOOPBACK: Final = IPv4Network("127.0.0.0/8")


class FoxgloveServer:
    """A server, which is a `Viewer`. Synchronization: one thread; the library has its own."""

    def __init__(self, host: str, port: int, origins: ViewerOrigins, *, note: Callable[[str], None]) -> None:
        """`note` says a problem for people, once each, also in the gate's thread.

        Raises ServerError where the address cannot be had.
        """
        self._note = note
        self._problem = ""
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        behind = hidden_address()
        try:
            self._server = foxglove.start_server(name="imud", host=behind, port=0, context=self._context)
        except RuntimeError as error:  # what foxglove-sdk makes of every error of the operating system
            raise ServerError(f"foxglove-sdk cannot listen on {behind}, behind imud's own port: {error}") from error
        try:
            self._gate = ViewerGate(host, port, (behind, self._server.port), origins, note=note)
        except ServerError:
            self._server.stop()
            raise
        self.url: Final = f"ws://{f'[{host}]' if ':' in host else host}:{self._gate.port}"

    @property
    def is_looked_at(self) -> bool:
        """Whether a client has subscribed to anything."""
        return any(channel.has_sinks() for channel in self._channels.values())

    def open(self, channel: MessageChannel[Any]) -> None:
        """Offer a channel; no-op for one whose topic is offered already."""
        if channel.topic not in self._channels:
            name, encoding, data = channel.schema
            self._channels[channel.topic] = foxglove.Channel(
                channel.topic,
                schema=foxglove.Schema(name=name, encoding=encoding, data=data),
                message_encoding=channel.message_encoding,
                context=self._context,
            )

    def close_topic(self, topic: str) -> None:
        """Offer it no more; no-op for one that is not."""
        channel = self._channels.pop(topic, None)
        if channel is not None:
            channel.close()

    def send(self, channel: MessageChannel[Any], item: object, utc_ns: int) -> None:
        """Make a message of `item` if a client wants it, and send it."""
        offered = self._channels[channel.topic]
        if offered.has_sinks():
            data = channel.encode(item)
            if data is not None:
                offered.log(data, log_time=max(utc_ns, 0))

    def problem(self, text: str) -> None:
        """Show clients and the terminal why nothing comes; empty: it does."""
        if text == self._problem:
            return
        self._problem = text
        if text:
            self._note(text)
            self._server.publish_status(text, StatusLevel.Error, STATUS_ID)
        else:
            self._note("samples come again")
            self._server.remove_status([STATUS_ID])

    def close(self) -> None:
        """End the server; may be called twice."""
        self._gate.close()
        self._server.stop()


def hidden_address() -> str:
    """Choose one of 16 million addresses of this machine: with its port, no page finds the server by trying."""
    return str(LOOPBACK[1 + secrets.randbelow(LOOPBACK.num_addresses - 2)])
