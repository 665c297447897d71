"""A sample with all fields, a sample with few fields, and the expected values in messages."""

from imud.model.event import Event, EventKind
from imud.model.sample import Position, Sample, Sync

UTC_NS = 1_790_000_000_123_456_789
FULL = Sample(
    device="bow", seq=7, t_ns=80_000_000_000_000, t_err_ns=12_000, sync=Sync.EDGE, t_rx_ns=80_000_000_200_000,
    utc_ns=UTC_NS, t_dev_ns=5_000_000, accel_m_s2=(0.125, -0.5, 9.75), gyro_rad_s=(0.25, 0.5, -0.75),
    mag_t=(1e-5, -2e-5, 4e-5), quat_wxyz=(0.5, 0.5, -0.5, 0.5), euler_rad=(0.1, 0.2, 0.3), temperature_c=31.5,
    pressure_pa=101325.0, incli_rad=(0.01, 0.02), status=3, pps_age_ms=40, edge_seq=9,
    velocity_enu_m_s=(1.5, -2.5, 0.25), position=Position(0.5, -1.25, 42.5, 4, 17), heave_m=-0.125,
    gnss_utc_ns=UTC_NS + 9,
)  # fmt: skip
BARE = Sample(
    device="bow", seq=8, t_ns=80_000_010_000_000, t_err_ns=0xFFFF_FFFF, sync=Sync.ARRIVAL, t_rx_ns=80_000_010_200_000,
    utc_ns=UTC_NS + 10_000_000, gyro_rad_s=(0.0, float("nan"), 1.0),
)  # fmt: skip
EVENT = Event(79_999_000_000_000, "bow", EventKind.LOSS, 'lost 3, "damaged"', {"count": 3, "cause": "crc"})
