"""The base of every part's settings: frozen, keyword-only, unknown keys refused, each field with a default.

A leaf file declares its own; `imud.config` fills it from YAML through msgspec, which checks types and `msgspec.Meta`
bounds. Docstrings below the fields are what the documentation of the key says.
"""

import msgspec


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of one part."""


class NoSettings(Settings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """For parts that have none."""
