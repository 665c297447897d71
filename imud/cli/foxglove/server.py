"""The WebSocket server of `imud foxglove`, by foxglove-sdk. It needs the extra `foxglove`."""

from collections.abc import Callable
from typing import Any, Final

import foxglove
from foxglove.websocket import StatusLevel

from imud.bridges.channel import MessageChannel
from imud.errors import ServerError

STATUS_ID: Final = "daemon"
"""Of the status message that says why nothing comes."""


class FoxgloveServer:
    """A server, which is a `Viewer`. Synchronization: one thread; the library has its own."""

    def __init__(self, host: str, port: int, *, note: Callable[[str], None]) -> None:
        """`note` says a problem for people, once each. Raises ServerError where the address cannot be had."""
        self._note = note
        self._problem = ""
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        try:
            self._server = foxglove.start_server(name="imud", host=host, port=port, context=self._context)
        except RuntimeError as error:  # the library's only one
            raise ServerError(
                f"cannot listen on {host} port {port}: {error}; is another `imud foxglove` running? (ss -ltnp)"
            ) from error
        self.url: Final = f"ws://{f'[{host}]' if ':' in host else host}:{self._server.port}"

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
        self._server.stop()
