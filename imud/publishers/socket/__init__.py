"""The UNIX socket: JSON-RPC 2.0, samples as JSON or binary, events, commands."""
