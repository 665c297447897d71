"""What Home Assistant is to make of a device: one retained configuration for each, by which it finds it by itself.

    homeassistant/device/imud_GATEWAY_DEVICE_CRC/config   {device, origin, availability, components}

Device-based discovery (Home Assistant, "MQTT", section "Device discovery payload"; since its version 2024.11). Its
parts read what imud sends anyway: the retained `status`, and `statistics` where the device has any. The last will of
the gateway makes all of them unavailable. An empty configuration removes them.
"""

from collections.abc import Mapping
from typing import Final
from zlib import crc32

from imud import __version__
from imud.contracts.status import DeviceState, DeviceStatus
from imud.formats.fleet.topics import STATE, STATUS, Stream, topic_of
from imud.publishers.mqtt.settings import DeviceSending
from imud.publishers.mqtt.streams import Gateway

PREFIX: Final = "homeassistant"
"""The prefix of discovery that Home Assistant has unless it was changed there."""
DEG_PER_RAD: Final = "57.29577951308232"
"""180 / π, in templates."""
ANGLES: Final = ("roll", "pitch", "yaw")
"""Components of `euler_rad`."""


def discovery_topic(gateway: Gateway, device: str) -> str:
    """The topic of a device's configuration. The check sum keeps `a_b` of `c` apart from `a` of `b_c`."""
    return f"{PREFIX}/device/{_unique_id(gateway, device)}/config"


def discovery_of(gateway: Gateway, status: DeviceStatus, sending: DeviceSending) -> Mapping[str, object]:
    """The configuration of a device with all its parts."""
    unique_id = _unique_id(gateway, status.name)
    parts = _status_parts(topic_of(gateway.site, gateway.gateway, status.name, STATUS))
    if sending.rate_hz and "mean" in sending.values:
        parts |= _attitude_parts(topic_of(gateway.site, gateway.gateway, status.name, Stream.STATISTICS))
    identity = {
        key: status.identity[name]
        for key, name in (("model", "product"), ("serial_number", "serial_number"), ("sw_version", "firmware"))
        if status.identity.get(name)
    }
    return {
        "device": {"identifiers": [unique_id], "name": f"{gateway.gateway} {status.name}", **identity},
        "origin": {"name": "imud", "sw_version": __version__},
        "availability": [
            {
                "topic": topic_of(gateway.site, gateway.gateway, "", STATE),
                "value_template": "{{ 'online' if value_json.online else 'offline' }}",
            }
        ],
        "components": {name: {**part, "unique_id": f"{unique_id}_{name}"} for name, part in parts.items()},
        "qos": 1,
    }


def _unique_id(gateway: Gateway, device: str) -> str:
    whole = f"{gateway.site}/{gateway.gateway}/{device}"
    return f"imud_{gateway.gateway}_{device}_{crc32(whole.encode()):08x}"


def _status_parts(topic: str) -> dict[str, dict[str, object]]:
    """What the retained state has."""
    diagnostic = {"state_topic": topic, "entity_category": "diagnostic"}
    return {
        "running": {
            "platform": "binary_sensor", "name": "Running", "device_class": "running", **diagnostic,
            "value_template": f"{{{{ 'ON' if value_json.state == '{DeviceState.RUNNING.value}' else 'OFF' }}}}",
        },
        "rate": {
            "platform": "sensor", "name": "Sample rate", "device_class": "frequency", "state_class": "measurement",
            "unit_of_measurement": "Hz", **diagnostic, "value_template": "{{ value_json.rate_hz | round(1) }}",
        },
        "temperature": {
            "platform": "sensor", "name": "Temperature", "device_class": "temperature", "state_class": "measurement",
            "unit_of_measurement": "°C", "state_topic": topic,
            "value_template": "{{ value_json.temperature_c | round(1) if value_json.temperature_c is number else '' }}",
        },
    }  # fmt: skip


def _attitude_parts(topic: str) -> dict[str, dict[str, object]]:
    """Means of the newest interval. A message without intervals, or a device without angles, gives an empty value,
    which Home Assistant leaves out."""
    found: dict[str, dict[str, object]] = {}
    for at, name in enumerate(ANGLES):
        newest = "value_json.intervals[-1]['values']"
        value = f"({newest}.euler_rad.mean[{at}] * {DEG_PER_RAD}) | round(2)"
        found[name] = {
            "platform": "sensor", "name": name.capitalize(), "state_class": "measurement", "unit_of_measurement": "°",
            "state_topic": topic, "suggested_display_precision": 1,
            "value_template": (
                f"{{{{ {value} if 'intervals' in value_json and 'euler_rad' in {newest} else '' }}}}"
            ),
        }  # fmt: skip
    return found
