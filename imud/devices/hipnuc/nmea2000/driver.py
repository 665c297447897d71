"""Table: the row `DRIVER` of heading and attitude sensors on NMEA 2000."""

from collections.abc import Mapping
from random import Random
from typing import Final

from imud.attitude import euler312_from_quat, quat_normalized
from imud.contracts.can import CanDriver
from imud.contracts.driver import SAMPLE_COUNTER, Identity
from imud.contracts.session import says_nothing
from imud.devices.hipnuc.common.data_sheet import FLOATS
from imud.devices.hipnuc.nmea2000 import messages
from imud.devices.hipnuc.nmea2000.codec import HipnucNmea2000Codec, HipnucNmea2000Settings, encode
from imud.devices.hipnuc.nmea2000.messages import Reference
from imud.formats.can import CanFilter, CanFrame
from imud.formats.j1939 import filter_of, sender_of
from imud.frames.conventions import Heading

EXAMPLE_SOURCE: Final = 35


def _example_frames(random: Random) -> list[CanFrame]:
    """A sample of all three, with random values."""
    quat = quat_normalized((random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1), random.gauss(0, 1)))
    euler = euler312_from_quat(quat)
    sid = random.randrange(messages.SID_MOST + 1)
    made = (
        encode(messages.HEADING, messages.pack_heading(sid, euler[2], Reference.MAGNETIC), EXAMPLE_SOURCE),
        encode(messages.RATE_OF_TURN, messages.pack_rate_of_turn(sid, random.gauss(0, 0.5)), EXAMPLE_SOURCE),
        encode(messages.ATTITUDE, messages.pack_attitude(sid, euler, has_yaw=False), EXAMPLE_SOURCE),
    )
    return [CanFrame(can_id, True, data, 0) for can_id, data in made]


def _filters(settings: HipnucNmea2000Settings) -> list[CanFilter]:
    """The three messages, of one sender or of any."""
    source = None if settings.source == "auto" else settings.source
    return [filter_of(pgn, source) for pgn in messages.PGNS]


def _node_of(can_id: int, extended: bool, data: bytes) -> int | None:
    """The sender of one of the messages."""
    return sender_of(can_id, extended, data, messages.PGNS)


def _heading(settings: object, _read_back: Mapping[str, str]) -> Heading:
    """By the heading that is used; with `auto` the first that is received, which is not known beforehand."""
    chosen = settings.heading if isinstance(settings, HipnucNmea2000Settings) else "auto"
    return Heading.UNKNOWN if chosen == "auto" else Heading(chosen)


DRIVER: Final = CanDriver(
    name="hipnuc-nmea2000",
    title="HiPNUC CH0x0, CH10x, HI14, other heading and attitude sensors (CAN, NMEA 2000)",
    settings=HipnucNmea2000Settings,
    make_codec=HipnucNmea2000Codec,
    filters=_filters,
    tick_ns=SAMPLE_COUNTER,
    tick_modulus=2,
    euler_convention="312: yaw about Z, then pitch about X, then roll about Y; yaw counter-clockwise from above, "
    "0 with the bow to the north of the heading's reference; NaN for an angle that is not sent",
    navigation_frame="ENU",
    data_sheet=FLOATS,
    heading=_heading,
    node_of=_node_of,
    node_settings=lambda source: HipnucNmea2000Settings(source=source),
    node_title=lambda source: f"source {source}",
    identify=lambda _settings: says_nothing(Identity()),
    read_settings=lambda _settings: says_nothing({}),
    sample_frames=len(messages.PGNS),
    example_frames=_example_frames,
)
