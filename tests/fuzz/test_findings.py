"""Findings of the fuzzers, one test for each. The docstring of a test names the target and the former fault."""

from pathlib import Path
from typing import Any

import pytest

from imud import config
from imud.client.connection import EventStream, Watch
from imud.formats.jsonrpc import encode_result, line_of
from imud.formats.ring import OFFSETS
from imud.model.errors import ConfigError, ServerError
from imud.publishers.metrics.publisher import encoder_for
from imud.utc.receivers import LINE_BYTES_MAX, SentenceSplitter
from imud.web.messages import CallRequest, LoginRequest, Look, decode_body
from tests.fuzz import answers, c_header
from tests.fuzz.shm import HEALTH, written

SENTENCE = b"$GPRMC,083559.00,A,4717.11437,N,00833.91522,E,0.004,77.52,091202,,,A*57\r\n"


@pytest.mark.parametrize("size", [100, LINE_BYTES_MAX, 3 * LINE_BYTES_MAX])
def test_splitter_skips_too_long_line_in_any_chunks(size: int) -> None:
    """utc/sentences: the splitter found a sentence in the long line only if it received the line in one chunk."""
    stream = b"x" * LINE_BYTES_MAX + SENTENCE + SENTENCE
    splitter = SentenceSplitter()
    parts = [stream[at : at + size] for at in range(0, len(stream), size)]
    assert [found for part in parts for found in splitter.feed(part)] == [SENTENCE]


@pytest.mark.parametrize("version", ["x", "1.x", "", "1.0.0"])
def test_server_replies_to_scrape_with_any_version(version: str) -> None:
    """http/request: prometheus_client raised TypeError for a version that is not a number; no reply was sent."""
    _, content_type = encoder_for(f"application/openmetrics-text; version={version}")
    assert content_type.startswith(("text/plain", "application/openmetrics-text"))


@pytest.mark.parametrize(
    "text",
    [
        'devices: {a: {uart: {port: "/dev/tty\\0"}}}',
        'devices: {a: {driver: hipnuc-canopen, socketcan: {interface: "can0\\n"}}}',
        'socket: {path: "/run/\\x7f/s"}\ndevices: {}',
        'shm: {group: "a\\eb"}\ndevices: {}',
        'state_dir: "/var/\\Lx"\ndevices: {}',
    ],
)
def test_config_rejects_control_characters(text: str) -> None:
    """config/yaml: an escape in quotes produced a path with NUL. The daemon ended with a ValueError."""
    with pytest.raises(ConfigError, match="expected text without control characters, got") as refused:
        config.parse(text, "imud.yaml")
    assert str(refused.value).isprintable()


@pytest.mark.parametrize(
    "text",
    [
        "devices: {a: {driver: imu61x-spi, options: {gyro_filter: 22}, spi: {port: /dev/spidev0.0, rate_hz: 500}}}",
        "devices: {a: {driver: imu61x-i2c, options: {nothing: 1}, i2c: {bus: 1, rate_hz: 500}}}",
    ],
)
def test_config_rejects_invalid_options_of_polled_driver(text: str) -> None:
    """config/yaml: imud computed the load of a bus from invalid options and raised an AttributeError."""
    with pytest.raises(ConfigError, match=r"imud\.yaml:1:.*options"):
        config.parse(text, "imud.yaml")


@pytest.mark.parametrize("kind", [LoginRequest, CallRequest, Look])
@pytest.mark.parametrize(
    "body", [b'{"params":{"a":' + b"[" * 30_000, b'{"token":"\xff","method":"\xff","device":"\xff"}']
)
def test_decode_body_raises_value_error_for_invalid_body(kind: type, body: bytes) -> None:
    """http/request: a POST to `imud web` with such a body received status 500, and the log contained a traceback."""
    with pytest.raises(ValueError, match=r"nested too deeply|can't decode byte|unknown field|malformed"):
        decode_body(body, kind)


@pytest.mark.parametrize("method", ["{}", "[]", "5", "null"])
def test_non_string_method_raises_server_error(method: str) -> None:
    """client/answers: the iterators raised TypeError, because an object cannot be a key of a mapping."""
    watched = line_of(encode_result(1, {"devices": {"bow": 0}}))
    for use in (1, 2):  # 1: events, 2: samples
        answers.run(bytes([use]) + watched + b'{"jsonrpc":"2.0","method":%s}\n' % method.encode())


@pytest.mark.parametrize("result", [None, 5, [], {}, "x"])
def test_invalid_result_raises_server_error(result: object) -> None:
    """client/answers: the methods of the client raised TypeError, KeyError or ValidationError of msgspec."""
    answer = line_of(encode_result(1, result))
    for use in (0, 2, 4):  # 0: requests, 2: samples, 4: end of a recording
        answers.run(bytes([use]) + answer)


@pytest.mark.parametrize(
    ("name", "params"),
    [
        ("sample", []), ("sample", {"device": "bow", "dropped": "x"}), ("device", {"device": "bow"}),
        ("device", {"device": "bow", "device_id": []}),
    ],
)  # fmt: skip
def test_invalid_notification_raises_server_error(name: str, params: object) -> None:
    """client/answers: a TypeError or KeyError ended the iterator."""
    message = {"method": name, "params": params}
    with pytest.raises(ServerError, match="cannot decode"):
        next(Watch(_Once(message), {"bow": 0}, None))  # type: ignore[arg-type]  # has the methods that Watch uses


@pytest.mark.parametrize("params", [[], {"t_ns": "x", "device": "bow", "kind": "up", "message": ""}])
def test_invalid_event_raises_server_error(params: object) -> None:
    """client/answers: the client returned the event unchanged or raised TypeError."""
    message = {"method": "event", "params": params}
    with pytest.raises(ServerError, match="cannot decode"):
        next(EventStream(_Once(message), None))  # type: ignore[arg-type]  # has the methods that EventStream uses


class _Once:
    """A source with one message."""

    def __init__(self, message: dict[str, Any]) -> None:
        self._message = message

    def kept_message(self, _names: frozenset[str]) -> None:
        return None

    def next_message(self, _names: frozenset[str], _timeout_s: float | None) -> dict[str, Any]:
        return self._message


def test_maximum_heartbeat_causes_no_undefined_behavior(tmp_path: Path) -> None:
    """c-header: `now_ns - heartbeat_ns` overflowed in imud_health."""
    if problem := c_header.build(tmp_path):
        pytest.skip(problem)
    program = tmp_path / "program"
    heartbeat = (1 << 63).to_bytes(8, "little")
    program.write_bytes(bytes([0, 0]) + written(OFFSETS["heartbeat_ns"], heartbeat) + bytes([HEALTH]))
    done = c_header.run_once(tmp_path, [program])
    assert done.returncode == 0, done.stderr
