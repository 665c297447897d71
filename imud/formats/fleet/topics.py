"""Topics of gateways: made from checked names, and taken apart again.

    imud/<site>/<gateway>/state                  retained: birth, death or last will
    imud/<site>/<gateway>/events                 events of the daemon itself
    imud/<site>/<gateway>/<device>/samples       whole samples in batches
    imud/<site>/<gateway>/<device>/statistics    intervals: mean, or minimum, maximum, mean and RMS
    imud/<site>/<gateway>/<device>/events
    imud/<site>/<gateway>/<device>/status        retained
    imud/<site>/<gateway>/<device>/settings      retained: the device's own settings, and where they are not as declared
    imud/<site>/<gateway>/<device>/command       requests to the gateway, where it takes any
    imud/<site>/<gateway>/<device>/answer        answers to them; also answer/<name>
    imud/<site>/<gateway>/<device>/schema        retained: what the samples mean and how slots are laid out

A name is one level of a topic: without `/`, without the wildcards `+` and `#`, and without `$` at its beginning, which
brokers keep for themselves (MQTT 5.0, section 4.7). Only letters, digits, `_` and `-` are taken.
"""

import re
from enum import StrEnum
from typing import Final, NamedTuple

ROOT: Final = "imud"
NAME_PATTERN: Final = "[A-Za-z0-9_-]{1,64}"
"""64 characters: of a topic of 65,535 bytes every name takes a small part, and a client id of three stays short."""
_NAME: Final = re.compile(NAME_PATTERN)


class Stream(StrEnum):
    """What is counted by itself: each stream of each device has numbers without gaps."""

    SAMPLES = "samples"
    """Whole samples, by their `seq`."""
    STATISTICS = "statistics"
    """Intervals, by the `seq` of the samples in them."""
    EVENTS = "events"
    """Events, counted from 1 since the start of the daemon."""


STATE: Final = "state"
STATUS: Final = "status"
SCHEMA: Final = "schema"
SETTINGS: Final = "settings"
COMMAND: Final = "command"
ANSWER: Final = "answer"
_DEVICE_TOPICS: Final = frozenset((*Stream, STATUS, SETTINGS, SCHEMA, COMMAND, ANSWER))
_GATEWAY_TOPICS: Final = frozenset((STATE, Stream.EVENTS))


class TopicParts(NamedTuple):
    """A topic, taken apart."""

    site: str
    gateway: str
    device: str
    """Empty for what is of the gateway itself."""
    leaf: str
    """`state`, `status`, `settings`, `schema`, `command`, `answer`, or the name of a `Stream`."""


def is_name(text: str) -> bool:
    """Whether a text can be the name of a site, a gateway or a device."""
    return _NAME.fullmatch(text) is not None


def topic_of(site: str, gateway: str, device: str, leaf: str) -> str:
    """Make a topic; without a device that of the gateway. Raises ValueError for a name that is none."""
    names = (site, gateway, device) if device else (site, gateway)
    for name in names:
        if not is_name(name):
            raise ValueError(f"expected a name of 1 to 64 letters, digits, '_' or '-', got {name!r}")
    if leaf not in (_DEVICE_TOPICS if device else _GATEWAY_TOPICS):
        raise ValueError(f"expected the end of a topic of a {'device' if device else 'gateway'}, got {leaf!r}")
    return "/".join((ROOT, *names, leaf))


def parse_topic(topic: str) -> TopicParts | None:
    """Take a topic apart; None for one that is no gateway's."""
    parts = topic.split("/")
    if parts[0] != ROOT or len(parts) not in (4, 5) or not all(map(is_name, parts)):
        return None
    device = parts[3] if len(parts) == 5 else ""
    if parts[-1] not in (_DEVICE_TOPICS if device else _GATEWAY_TOPICS):
        return None
    return TopicParts(parts[1], parts[2], device, parts[-1])
