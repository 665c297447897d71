"""Topics: valid names, and the parts of a topic."""

import pytest

from imud.fleet.messages import SCHEMA, STATE, STATUS, Stream, TopicParts, parse_topic, topic_of


def test_topics_are_as_documented() -> None:
    assert topic_of("mill", "gw-1", "", STATE) == "imud/mill/gw-1/state"
    assert topic_of("mill", "gw-1", "", Stream.EVENTS) == "imud/mill/gw-1/events"
    assert topic_of("mill", "gw-1", "bow", Stream.SAMPLES) == "imud/mill/gw-1/bow/samples"
    assert parse_topic("imud/mill/gw-1/bow/statistics") == TopicParts("mill", "gw-1", "bow", "statistics")
    assert parse_topic("imud/mill/gw-1/state") == TopicParts("mill", "gw-1", "", "state")


@pytest.mark.parametrize("name", ["", "a/b", "+", "#", "$SYS", "a b", "ä", "x" * 65, "a\0", "a\n"])
def test_an_invalid_name_raises_an_error(name: str) -> None:
    with pytest.raises(ValueError, match="letters, digits"):
        topic_of(name, "gw", "bow", STATUS)
    with pytest.raises(ValueError, match="letters, digits"):
        topic_of("site", name, "bow", STATUS)
    if name:
        with pytest.raises(ValueError, match="letters, digits"):
            topic_of("site", "gw", name, STATUS)
    with pytest.raises(ValueError, match="of a device"):
        topic_of("site", "gw", "bow", STATE)
    with pytest.raises(ValueError, match="of a gateway"):
        topic_of("site", "gw", "", SCHEMA)


@pytest.mark.parametrize(
    "topic",
    [
        "", "imud", "imud/a/b", "imud/a/b/status", "imud/a/b/c/state", "imud/a/b/c/d/e", "other/a/b/state",
        "imud/a//state",
    ],
)  # fmt: skip
def test_other_topics_are_not_parsed(topic: str) -> None:
    assert parse_topic(topic) is None
