"""The vendor's DBC file and the codec give equal values for every signal they share."""

import math
from random import Random

import cantools
import pytest

from imud.devices.hipnuc.canopen.codec import HipnucCanopenCodec, HipnucCanopenSettings
from imud.ledger import Ledger
from imud.sample import Measurement
from tests.support.files import shared

SIZES = {0x188: 6, 0x288: 6, 0x388: 6, 0x488: 8, 0x688: 4, 0x788: 8}
BURSTS = 300
G_M_S2 = 9.8


def scaled(values: dict[str, float], names: str, factor: float) -> list[float]:
    return [values[name] * factor for name in names.split()]


def test_random_payloads_decode_alike() -> None:
    database = cantools.database.load_file(shared("hipnuc-canopen.dbc"))
    assert isinstance(database, cantools.database.Database)
    assert {message.frame_id: message.length for message in database.messages} == SIZES
    codec, random = HipnucCanopenCodec(Ledger(), HipnucCanopenSettings()), Random(7)
    compared = 0
    for burst in range(BURSTS):
        values: dict[str, float] = {}
        for place, (can_id, size) in enumerate(SIZES.items()):
            data = random.randbytes(size)
            decoded = database.decode_message(can_id, data)
            assert isinstance(decoded, dict)
            for name, value in decoded.items():
                assert isinstance(value, int | float)
                values[name] = value
            events = codec.feed_frame(can_id, False, data, burst * 10_000_000 + place * 250_000)
        for m in events:
            assert isinstance(m, Measurement)
            assert m.accel_m_s2 == pytest.approx(scaled(values, "Acc_X Acc_Y Acc_Z", G_M_S2), rel=1e-12)
            assert m.gyro_rad_s == pytest.approx(scaled(values, "Gyr_X Gyr_Y Gyr_Z", math.pi / 180), rel=1e-12)
            assert m.euler_rad == pytest.approx(scaled(values, "Roll Pitch Yaw", math.pi / 180), rel=1e-12)
            assert m.quat_wxyz == pytest.approx(scaled(values, "Quat_W Quat_X Quat_Y Quat_Z", 1), rel=1e-12)
            assert m.pressure_pa == values["Pressure"]
            assert m.incli_rad == pytest.approx(scaled(values, "Incli_X Incli_Y", math.pi / 180), rel=1e-12)
            compared += len(values)
    assert len(values) == 16
    assert compared >= 16 * (BURSTS - 6)
