"""The index of the simulated IMU61x on CAN. tests/sim/test_can_module.py checks its values and times."""

from imud.drivers.imu61x.can import Imu61xCanCodec, Imu61xCanOptions
from imud.model.ledger import Ledger
from imud.model.sample import Measurement
from imud.sim.can_module import SentFrame
from imud.sim.imu61x.can import Imu61xCanHardware, Imu61xCanModule

BEGIN_NS = 5_000_000_000
SECOND_NS = 1_000_000_000


def indices(frames: list[SentFrame]) -> list[int | None]:
    codec = Imu61xCanCodec(Ledger(), Imu61xCanOptions())
    events = [event for f in frames for event in codec.feed_frame(f.can_id, f.extended, f.data, f.due_ns)]
    return [event.dev_ticks for event in events if isinstance(event, Measurement)]


def test_the_index_has_16_bits_and_starts_again_after_a_restart() -> None:
    module = Imu61xCanModule(BEGIN_NS, Imu61xCanHardware(boot_ms=0, index=65530))
    found = indices(module.advance(BEGIN_NS + SECOND_NS))
    assert found[:8] == [65530, 65531, 65532, 65533, 65534, 65535, 0, 1]
    module.reboot(BEGIN_NS + SECOND_NS)
    assert indices(module.advance(BEGIN_NS + SECOND_NS + SECOND_NS // 10))[0] == 0
