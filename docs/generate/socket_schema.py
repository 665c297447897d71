"""JSON Schema of every message of the UNIX socket, made from the types.

docs/socket.schema.json allows unknown members, as the protocol does.
"""

import json
from copy import deepcopy
from typing import Any, Final

import msgspec

from imud.formats.jsonrpc import Code, is_big
from imud.publishers.socket.messages import NOTIFICATIONS
from imud.publishers.socket.methods import METHODS
from imud.publishers.socket.outbox import ALWAYS_FIELDS

DIALECT: Final = "https://json-schema.org/draft/2020-12/schema"
DIGITS: Final = "^-?[0-9]+$"
OPEN_ENUMS: Final = ("EventKind",)
"""Enumerations that later versions may extend. Readers must accept unknown values."""
ID: Final = {"type": ["string", "number", "null"]}

Schema = dict[str, Any]


def socket_document() -> Schema:
    """Return the schema: any message, with requests, replies and notifications by name in `$defs`."""
    requests = {name: method.params for name, method in METHODS.items()}
    results = {name: method.result for name, method in METHODS.items()}
    incoming, described = _components(list(requests.values()))
    outgoing, more = _components([*results.values(), *NOTIFICATIONS.values()])
    for part in more.values():
        _as_sent(part)
    for part in outgoing:
        _as_sent(part)
    _finish(more)
    messages = {
        **{f"request.{name}": _request(name, one) for name, one in zip(requests, incoming, strict=True)},
        **{f"reply.{name}": _reply(one) for name, one in zip(results, outgoing, strict=False)},
        "reply.error": _error(),
        **{
            f"notification.{name}": _notification(name, one)
            for name, one in zip(NOTIFICATIONS, outgoing[len(results) :], strict=True)
        },
    }
    return {
        "$schema": DIALECT,
        "title": "Messages of imud's UNIX socket",
        "description": "One message per line; docs/socket.md says what they mean. Members that a reader does not know "
        "are to be ignored.",
        "anyOf": [{"$ref": f"#/$defs/{name}"} for name in messages],
        "$defs": {**messages, **dict(sorted({**described, **more}.items()))},
    }


def socket_schema() -> str:
    """Return the text of docs/socket.schema.json."""
    return json.dumps(socket_document(), indent=1, ensure_ascii=False) + "\n"


def _components(types: list[Any]) -> tuple[list[Schema], dict[str, Schema]]:
    schemas, components = msgspec.json.schema_components(types, ref_template="#/$defs/{name}")
    return [deepcopy(dict(one)) for one in schemas], {name: deepcopy(dict(one)) for name, one in components.items()}


def _request(name: str, params: Schema) -> Schema:
    required = ["jsonrpc", "method"]
    if METHODS[name].params.__struct_fields__ and any(
        field.required for field in msgspec.structs.fields(METHODS[name].params)
    ):
        required.append("params")
    properties = {"jsonrpc": {"const": "2.0"}, "id": ID, "method": {"const": name}, "params": params}
    return {"type": "object", "properties": properties, "required": required}


def _reply(result: Schema) -> Schema:
    properties = {"jsonrpc": {"const": "2.0"}, "id": ID, "result": result}
    return {"type": "object", "properties": properties, "required": ["jsonrpc", "id", "result"]}


def _error() -> Schema:
    codes = {"type": "integer", "examples": [int(code) for code in Code]}
    error = {"type": "object", "properties": {"code": codes, "message": {"type": "string"}, "data": {"type": "object"}}}
    error["required"] = ["code", "message"]
    properties = {"jsonrpc": {"const": "2.0"}, "id": ID, "error": error}
    return {"type": "object", "properties": properties, "required": ["jsonrpc", "id", "error"]}


def _notification(name: str, params: Schema) -> Schema:
    properties = {"jsonrpc": {"const": "2.0"}, "method": {"const": name}, "params": params}
    return {"type": "object", "properties": properties, "required": ["jsonrpc", "method", "params"]}


def _as_sent(schema: Any) -> None:
    """Apply the rules of the encoder: NaN is null, and integers that may exceed 53 bits can be strings."""
    if isinstance(schema, list):
        for one in schema:
            _as_sent(one)
    if not isinstance(schema, dict):
        return
    for name, one in schema.get("properties", {}).items():
        if is_big(name):
            _allow_text(one)
    if schema.get("type") == "number":
        schema["type"] = ["number", "null"]
    for one in schema.values():
        _as_sent(one)


def _allow_text(schema: Schema) -> None:
    for one in [schema, *schema.get("anyOf", [])]:
        if one.get("type") == "integer":
            one |= {"type": ["integer", "string"], "pattern": DIGITS}


def _finish(components: dict[str, Schema]) -> None:
    """Add facts that are not in the types: optional fields, the member `dropped`, extensible enumerations."""
    sample = components["Sample"]
    sample["required"] = list(ALWAYS_FIELDS)
    sample["properties"]["dropped"] = {
        "type": "integer", "minimum": 1, "description": "samples of this device dropped right before this one",
    }  # fmt: skip
    for name in OPEN_ENUMS:
        components[name]["examples"] = components[name].pop("enum")
        components[name]["type"] = "string"
