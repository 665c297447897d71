r"""The UNIX socket's wire format, for the server and its clients: JSON-RPC 2.0, one object per line, and binary frames.

    line     {"jsonrpc":"2.0",…}\n
    frame    +-----------------+------------------------------------------------------------+
             | length: u32, LE | length % 256 == 0: that many bytes of slots (slot.py)      |
             |                 | otherwise: one JSON object and its newline                 |
             +-----------------+------------------------------------------------------------+

The length gives the kind of a frame: a slot may begin with any byte, `{` included (seq 123), so its content does
not. JSON whose length happens to be a multiple of 256 gets a second newline.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

import msgspec

from imud.formats.slot import SLOT_BYTES
from imud.model.errors import ServerError

PROTOCOL: Final = 1
"""Counts up when an old client could misread the server. New methods and members leave it as it is."""
DEFAULT_PATH: Final = "/run/imud/imud.sock"
LINE_MAX_BYTES: Final = 65536
"""Longest line the server takes, newline left out: a `watch` that names every field of 1,000 devices is half of it."""
NESTED_MAX: Final = 64
"""Arrays and objects in a request, so that it cannot be nested deeper; arguments of actions have three at most."""
ITEMS_MAX: Final = 2048
"""Members and elements in a request, by its commas: names of every device and every field, with room."""
FRAME_HEADER: Final = struct.Struct("<I")
FRAME_MAX_BYTES: Final = 1 << 24
"""A client that reads a larger length has lost the frame boundary."""

RequestId = int | float | str | None


class Code(IntEnum):
    """Error codes: the first five by JSON-RPC 2.0 §5.1, the others imud's own."""

    PARSE = -32700
    """The line is not JSON."""
    INVALID_REQUEST = -32600
    """It is JSON, but not a request."""
    METHOD_NOT_FOUND = -32601
    INVALID_PARAMS = -32602
    INTERNAL = -32603
    DENIED = -32001
    """The peer lacks the permission."""
    TOO_MANY_CLIENTS = -32002
    LINE_TOO_LONG = -32003
    UNAVAILABLE = -32004
    """The daemon cannot give it now: out of descriptors."""
    FAILED = -32005
    """The device refused a command, did not answer, or is not there."""


class RpcError(ServerError):
    """The server answered with an error; `code` is one of `Code` or of a newer server."""

    def __init__(self, code: int, message: str, request_id: RequestId = None) -> None:
        super().__init__(message)
        self.code = code
        self.request_id = request_id
        """The id of the request where it could be read."""


@dataclass(frozen=True, slots=True)
class RpcRequest:
    """A request as it came, its parameters not checked yet."""

    method: str
    params: Mapping[str, Any]
    request_id: RequestId
    wants_reply: bool
    """False for a notification: a request without `id`."""


encode: Final = msgspec.json.Encoder().encode
"""JSON without spaces, NaN and infinity as null, never a raw newline inside."""
_decode: Final = msgspec.json.Decoder().decode


def parse_object(line: bytes | bytearray) -> dict[str, Any]:
    """The JSON object in `line`. Raises RpcError (PARSE, INVALID_REQUEST)."""
    try:
        value = _decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise RpcError(Code.PARSE, f"not JSON: {error}") from None
    except RecursionError:  # of a server's answer; a request is checked before
        raise RpcError(Code.PARSE, "not JSON that can be read: nested too deeply") from None
    if not isinstance(value, dict):
        raise RpcError(Code.INVALID_REQUEST, f"expected one JSON object per line, got {_kind(value)}")
    return value


def parse_request(line: bytes | bytearray) -> RpcRequest:
    """The request in `line`. Raises RpcError (PARSE, INVALID_REQUEST, INVALID_PARAMS)."""
    _check_bounds(line)
    value = parse_object(line)
    request_id = value.get("id")
    if isinstance(request_id, bool) or not isinstance(request_id, int | float | str | None):
        raise RpcError(Code.INVALID_REQUEST, f"id: expected a string, a number or null, got {_kind(request_id)}")
    if value.get("jsonrpc") != "2.0":
        raise RpcError(Code.INVALID_REQUEST, 'jsonrpc: expected the string "2.0"', request_id)
    method, params = value.get("method"), value.get("params", {})
    if not isinstance(method, str):
        raise RpcError(Code.INVALID_REQUEST, f"method: expected a string, got {_kind(method)}", request_id)
    if isinstance(params, list):
        raise RpcError(Code.INVALID_PARAMS, "params: expected an object, parameters are by name only", request_id)
    if not isinstance(params, dict):
        raise RpcError(Code.INVALID_REQUEST, f"params: expected an object, got {_kind(params)}", request_id)
    return RpcRequest(method, params, request_id, "id" in value)


def _check_bounds(line: bytes | bytearray) -> None:
    """Refuse what would be costly to parse or too deep to handle, without parsing. Brackets in strings count too."""
    if line.count(b"[") + line.count(b"{") > NESTED_MAX:
        raise RpcError(Code.PARSE, f"nested too deeply: expected at most {NESTED_MAX} arrays and objects")
    if line.count(b",") > ITEMS_MAX:
        raise RpcError(Code.PARSE, f"too long a list: expected at most {ITEMS_MAX} members and elements")


def encode_request(method: str, params: Mapping[str, Any], request_id: int) -> bytes:
    """A request, newline left out."""
    return encode({"jsonrpc": "2.0", "id": request_id, "method": method, "params": params})


def encode_notification(method: str, params: object, *, texts: bool = False) -> bytes:
    """A notification, newline left out; `texts`: with big numbers as text."""
    return encode({"jsonrpc": "2.0", "method": method, "params": with_texts(params) if texts else params})


def encode_result(request_id: RequestId, result: object, *, texts: bool = False) -> bytes:
    """The reply to a request that went well, newline left out; `texts`: with big numbers as text."""
    return encode({"jsonrpc": "2.0", "id": request_id, "result": with_texts(result) if texts else result})


def with_texts(value: object) -> object:
    """Convert to what JSON has, with integers as text whose members may exceed 2⁵³ (`is_big`)."""
    return _texts(msgspec.to_builtins(value))


def is_big(member: str) -> bool:
    """Whether a member of this name may have integers of more than 53 bits: `epoch`, and times in ns."""
    return member == "epoch" or member.endswith("_ns")


def _texts(value: object) -> object:
    if isinstance(value, dict):
        return {
            name: str(one) if type(one) is int and is_big(str(name)) else _texts(one) for name, one in value.items()
        }
    return [_texts(one) for one in value] if isinstance(value, list | tuple) else value


def encode_error(error: RpcError) -> bytes:
    """The reply to a request that did not, newline left out."""
    body = {"code": int(error.code), "message": str(error)}
    return encode({"jsonrpc": "2.0", "id": error.request_id, "error": body})


def line_of(body: bytes) -> bytes:
    """A JSON object as a line."""
    return body + b"\n"


def frame_of(body: bytes) -> bytes:
    """A JSON object as a frame."""
    body += b"\n" if (len(body) + 1) % SLOT_BYTES else b"\n\n"
    return FRAME_HEADER.pack(len(body)) + body


def _kind(value: object) -> str:
    """The JSON name of a value's type."""
    names = {dict: "an object", list: "an array", str: "a string", bool: "a boolean", type(None): "null"}
    return names.get(type(value), "a number")
