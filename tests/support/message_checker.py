"""Check of messages of the socket by docs/socket.schema.json, without members that the schema does not describe."""

from importlib.util import find_spec
from typing import Any

from docs.generate.socket_schema import socket_document
from imud.publishers.socket.messages import NOTIFICATIONS


class MessageChecker:
    """Checks messages by the closed schema. Without the package jsonschema it checks nothing."""

    def __init__(self) -> None:
        self.checked: dict[str, int] = {}
        """Number of checked messages, by name."""
        self._whole = socket_document()
        _close(self._whole)
        self._validators: dict[str, Any] = {}

    @property
    def able(self) -> bool:
        return find_spec("jsonschema") is not None

    def check(self, name: str, message: object) -> None:
        """Raise AssertionError unless `message` is valid for the entry `name` of `$defs`."""
        if not self.able:
            return
        validator = self._validators.get(name)
        if validator is None:
            from jsonschema import Draft202012Validator

            schema = {"$ref": f"#/$defs/{name}", "$defs": self._whole["$defs"]}
            validator = self._validators[name] = Draft202012Validator(schema)
        self.checked[name] = self.checked.get(name, 0) + 1
        errors = [f"{error.json_path}: {error.message}" for error in validator.iter_errors(message)]
        assert not errors, f"{name}: {errors[:3]}"

    def check_sent(self, message: dict[str, Any], method: str | None) -> None:
        """Check a message of the server. `method` is the method of its request, None if unknown."""
        if message.get("method") in NOTIFICATIONS:
            self.check(f"notification.{message['method']}", message)
        elif "error" in message:
            self.check("reply.error", message)
        elif method is not None:
            self.check(f"reply.{method}", message)


def _close(schema: Any) -> None:
    if isinstance(schema, dict):
        if "properties" in schema:
            schema.setdefault("additionalProperties", False)
        for one in schema.values():
            _close(one)
    elif isinstance(schema, list):
        for one in schema:
            _close(one)
