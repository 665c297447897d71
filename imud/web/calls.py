"""Questions and orders of pages to the daemon: each on a connection of its own, so that a calibration of minutes holds
up nothing else."""

import asyncio
from collections.abc import Mapping
from typing import Any, Final

from imud.client.connection import rpc_error
from imud.client.watch import params_of
from imud.errors import LinkDenied, LinkMissing, ServerError, reason_of
from imud.formats.jsonrpc import PROTOCOL, encode_request, line_of, parse_object

READING: Final = frozenset(("settings.get", "actions", "calibrations", "schema"))
"""Methods that need the right to read."""
CONTROLLING: Final = frozenset(("settings.plan", "settings.apply", "command", "calibrate", "stop_calibration"))
"""Methods that need the right to control, here and at the daemon."""
ANSWER_S: Final = 10.0
LONG_ANSWER_S: Final = 660.0
"""Longer than the daemon lets any calibration run."""
LONG: Final = frozenset(("command", "calibrate", "settings.apply"))
ANSWER_BYTES_MAX: Final = 1 << 22
"""The answer of `schema` for 256 devices is a tenth of it."""
AT_A_TIME_MAX: Final = 16
"""Questions and orders on their way; each is a connection to the daemon."""


class Busy(ServerError):
    """Too many questions at a time."""


class Calls:
    """The way to the daemon at `path`. Synchronization: one event loop."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._count = 0

    async def call(self, method: str, params: Mapping[str, Any]) -> Any:
        """Call a method of the daemon and return its result as JSON values.

        Raises RpcError (what the daemon refused), LinkMissing, LinkDenied, ServerError, TimeoutError, and Busy.
        """
        if self._count >= AT_A_TIME_MAX:
            raise Busy(f"{AT_A_TIME_MAX} requests are on their way, which is the most at a time; try again")
        self._count += 1
        try:
            async with asyncio.timeout(LONG_ANSWER_S if method in LONG else ANSWER_S):
                return await self._called(method, params)
        except TimeoutError:
            raise TimeoutError(f"{self._path}: the daemon did not answer {method}") from None
        finally:
            self._count -= 1

    async def _called(self, method: str, params: Mapping[str, Any]) -> Any:
        try:
            reader, writer = await asyncio.open_unix_connection(self._path, limit=ANSWER_BYTES_MAX)
        except PermissionError as error:
            raise LinkDenied(f"no permission for {self._path}: is the user of imud web in group imud?") from error
        except OSError as error:
            raise LinkMissing(f"no daemon at {self._path}: {reason_of(error)}") from error
        try:
            hello = await self._message(reader)
            if "error" in hello:
                raise LinkDenied(f"the daemon refuses: {rpc_error(hello['error'])}")
            if params_of(hello).get("protocol") != PROTOCOL:
                raise ServerError(f"{self._path}: expected a daemon of protocol {PROTOCOL}")
            writer.write(line_of(encode_request(method, params, 1)))
            await writer.drain()
            while (answer := await self._message(reader)).get("id", 0) not in (1, None):
                pass
        except OSError as error:
            raise LinkMissing(f"{self._path}: the connection to the daemon is lost: {reason_of(error)}") from error
        finally:
            writer.close()
        if "error" in answer:
            raise rpc_error(answer["error"])
        return answer.get("result")

    async def _message(self, reader: asyncio.StreamReader) -> dict[str, Any]:
        try:
            line = await reader.readline()
        except ValueError:
            raise ServerError(f"{self._path}: a line of more than {ANSWER_BYTES_MAX} bytes") from None
        if not line.endswith(b"\n"):
            raise LinkMissing(f"{self._path}: the daemon closed the connection")
        return parse_object(line)
