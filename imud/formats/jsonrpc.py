r"""Wire format of the UNIX socket: JSON-RPC 2.0, one object per line, and binary frames.

    line     {"jsonrpc":"2.0",…}\n
    frame    +-----------------+------------------------------------------------------------+
             | length: u32, LE | length % 320 == 0: slots of this total length (slot.py)    |
             |                 | otherwise: one JSON object and its newline                 |
             +-----------------+------------------------------------------------------------+

The length decides the kind of a frame, because a slot can start with any byte, for example `{` for seq 123. JSON with a
length that is a multiple of 320 ends with a second newline.
"""

import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

import msgspec

from imud.formats.slot import SLOT_BYTES
from imud.model.errors import ServerError

# Version of the protocol. It increases if an old client could misread the server, not for new methods and members.
PROTOCOL: Final = 1
DEFAULT_PATH: Final = "/run/imud/imud.sock"
# Maximum length of a request without newline, bytes. A `watch` with every field of 1,000 devices needs half of it.
LINE_MAX_BYTES: Final = 65536
# Maximum number of arrays and objects in a request. It limits the nesting; arguments of commands have at most three.
NESTED_MAX: Final = 64
# Maximum number of members and elements in a request, counted by commas. Enough for all devices with all fields.
ITEMS_MAX: Final = 2048
FRAME_HEADER: Final = struct.Struct("<I")
# Maximum length of a frame, bytes. A client that reads a larger length has lost the frame boundary.
FRAME_MAX_BYTES: Final = 1 << 24

RequestId = int | float | str | None


class Code(IntEnum):
    """Error codes: the first five by JSON-RPC 2.0 §5.1, all others by imud."""

    PARSE = -32700  # the line is not JSON
    INVALID_REQUEST = -32600  # the line is JSON and not a request
    METHOD_NOT_FOUND = -32601  # the daemon does not know the method
    INVALID_PARAMS = -32602  # a parameter is unknown, missing or out of range
    INTERNAL = -32603  # fault of the daemon
    DENIED = -32001  # the client lacks the permission
    TOO_MANY_CLIENTS = -32002  # the limit of connections is reached
    LINE_TOO_LONG = -32003  # the request is longer than 65,536 bytes
    UNAVAILABLE = -32004  # the daemon is temporarily unable to reply: out of descriptors
    FAILED = -32005  # the device rejected a command, did not reply, or is absent


class RpcError(ServerError):
    """Error reply of the server. `code` is a value of `Code` or a code of a newer server. `data` contains values for
    programs; None without such values."""

    def __init__(
        self, code: int, message: str, request_id: RequestId = None, data: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(message)
        self.code = code
        self.data = data
        self.request_id = request_id  # the id of the request, if it was readable


@dataclass(frozen=True, slots=True)
class RpcRequest:
    """Received request with unchecked parameters."""

    method: str
    params: Mapping[str, Any]
    request_id: RequestId
    wants_reply: bool  # false for a notification, a request without `id`


encode: Final = msgspec.json.Encoder().encode  # encodes JSON without spaces and raw newlines, NaN and infinity as null
_decode: Final = msgspec.json.Decoder().decode


def default_path() -> str:
    """Return the environment variable IMUD_SOCKET; /run/imud/imud.sock if it is not set or empty."""
    return os.environ.get("IMUD_SOCKET") or DEFAULT_PATH


def parse_object(line: bytes | bytearray) -> dict[str, Any]:
    """Return the JSON object in `line`. Raises RpcError (PARSE, INVALID_REQUEST)."""
    try:
        value = _decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise RpcError(Code.PARSE, f"not JSON: {error}") from None
    except RecursionError:  # only for replies of a server; `parse_request` limits requests
        raise RpcError(Code.PARSE, "cannot read the JSON: nested too deeply") from None
    if not isinstance(value, dict):
        raise RpcError(Code.INVALID_REQUEST, f"expected one JSON object per line, got {_kind(value)}")
    return value


def parse_request(line: bytes | bytearray) -> RpcRequest:
    """Return the request in `line`. Raises RpcError (PARSE, INVALID_REQUEST, INVALID_PARAMS)."""
    # limits of the work to parse the line; brackets and commas in strings count too
    if line.count(b"[") + line.count(b"{") > NESTED_MAX:
        raise RpcError(Code.PARSE, f"nested too deeply: expected at most {NESTED_MAX} arrays and objects")
    if line.count(b",") > ITEMS_MAX:
        raise RpcError(Code.PARSE, f"too many values: expected at most {ITEMS_MAX} members and elements")
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
        raise RpcError(Code.INVALID_PARAMS, "params: expected an object with the parameters by name", request_id)
    if not isinstance(params, dict):
        raise RpcError(Code.INVALID_REQUEST, f"params: expected an object, got {_kind(params)}", request_id)
    return RpcRequest(method, params, request_id, "id" in value)


def encode_request(method: str, params: Mapping[str, Any], request_id: int) -> bytes:
    """Return a request without newline."""
    return encode({"jsonrpc": "2.0", "id": request_id, "method": method, "params": params})


def encode_notification(method: str, params: object, *, texts: bool = False) -> bytes:
    """Return a notification without newline; `texts`: large integers as strings."""
    return encode({"jsonrpc": "2.0", "method": method, "params": with_texts(params) if texts else params})


def encode_result(request_id: RequestId, result: object, *, texts: bool = False) -> bytes:
    """Return a result without newline; `texts`: large integers as strings."""
    return encode({"jsonrpc": "2.0", "id": request_id, "result": with_texts(result) if texts else result})


def with_texts(value: object) -> object:
    """Return JSON types. Members that may exceed 2⁵³ (`is_big`) become strings."""
    return _texts(msgspec.to_builtins(value))


def is_big(member: str) -> bool:
    """Return whether a member with this name may exceed 53 bits: `epoch`, and times in ns."""
    return member == "epoch" or member.endswith("_ns")


def _texts(value: object) -> object:
    if isinstance(value, dict):
        return {
            name: str(one) if type(one) is int and is_big(str(name)) else _texts(one) for name, one in value.items()
        }
    return [_texts(one) for one in value] if isinstance(value, list | tuple) else value


def encode_error(error: RpcError) -> bytes:
    """Return an error reply without newline."""
    body: dict[str, Any] = {"code": int(error.code), "message": str(error)}
    if error.data is not None:
        body["data"] = error.data
    return encode({"jsonrpc": "2.0", "id": error.request_id, "error": body})


def line_of(body: bytes) -> bytes:
    """Return a JSON object as a line."""
    return body + b"\n"


def frame_of(body: bytes) -> bytes:
    """Return a JSON object as a frame."""
    # a multiple of SLOT_BYTES would mean slots
    body += b"\n" if (len(body) + 1) % SLOT_BYTES else b"\n\n"
    return FRAME_HEADER.pack(len(body)) + body


def _kind(value: object) -> str:
    """Return the JSON name of the type of a value."""
    names = {dict: "an object", list: "an array", str: "a string", bool: "a boolean", type(None): "null"}
    return names.get(type(value), "a number")
