"""Client of the Foxglove WebSocket protocol: aiohttp for WebSocket, rosbags for CDR."""

import asyncio
import json
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import aiohttp
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.support.daemon_process import LIMIT_S

SUBPROTOCOL = "foxglove.sdk.v1"
MESSAGE_DATA = 1


def decoder_of(channel: dict[str, Any]) -> Callable[[bytes], Any]:
    if channel["encoding"] == "json":
        assert channel["schemaEncoding"] == "jsonschema"
        return json.loads
    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
    name, store = channel["schemaName"], get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(channel["schema"], name))
    return lambda data: store.deserialize_cdr(data, name)


class ProtocolClient:
    """Client with the channels by topic and the decoded messages of its subscriptions."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self.channels: dict[str, dict[str, Any]] = {}
        self.statuses: list[str] = []
        self._topics: dict[int, str] = {}
        self._decoders: dict[str, Callable[[bytes], Any]] = {}

    async def receive(self, is_it: Callable[[str, int, Any], object]) -> tuple[str, int, Any]:
        while True:
            got = await asyncio.wait_for(self._socket.receive(), LIMIT_S)
            if got.type is aiohttp.WSMsgType.TEXT:
                self._note(json.loads(got.data))
                if is_it("", 0, None):
                    return "", 0, None
            elif got.type is aiohttp.WSMsgType.BINARY and got.data[0] == MESSAGE_DATA:
                subscription, t_ns = struct.unpack_from("<IQ", got.data, 1)
                topic = self._topics[subscription]
                message = self._decoders[topic](got.data[13:])
                if is_it(topic, t_ns, message):
                    return topic, t_ns, message
            else:
                assert got.type is aiohttp.WSMsgType.BINARY, got

    async def wait_for_channel(self, topic: str) -> None:
        if topic not in self.channels:
            await self.receive(lambda *_: topic in self.channels)

    async def subscribe(self, topic: str) -> None:
        await self.wait_for_channel(topic)
        number = len(self._topics) + 100
        self._topics[number] = topic
        self._decoders[topic] = decoder_of(self.channels[topic])
        wanted = [{"id": number, "channelId": self.channels[topic]["id"]}]
        await self._socket.send_json({"op": "subscribe", "subscriptions": wanted})

    def _note(self, told: dict[str, Any]) -> None:
        if told["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in told["channels"]}
        elif told["op"] == "status":
            self.statuses.append(told["message"])


@asynccontextmanager
async def connected(url: str) -> AsyncIterator[ProtocolClient]:
    async with aiohttp.ClientSession() as session, session.ws_connect(url, protocols=(SUBPROTOCOL,)) as socket:
        assert socket.protocol == SUBPROTOCOL
        yield ProtocolClient(socket)
