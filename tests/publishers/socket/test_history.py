"""History of one hour: minimum and maximum of each second, with the kernel and with the Python code."""

from math import inf, nan
from random import Random
from typing import Any

import msgspec
import pytest

from imud.attitude.conventions import RFU_ENU, Convention
from imud.attitude.published import as_sent
from imud.contracts.publisher import Batch
from imud.formats import kernel
from imud.model.bucket import VECTORS, Bucket
from imud.model.ledger import Ledger
from imud.model.sample import Sample
from imud.publishers.socket import history
from imud.publishers.socket.history import SECOND, History, buckets
from imud.publishers.socket.server import SocketOptions, SocketServer
from tests.support.publisher_context import publisher_context
from tests.support.socket_rig import Peer, batch, in_server, sample

S = 1_000_000_000
FRAME = as_sent(RFU_ENU)
HOUR = (0, 2**62)


@pytest.fixture(params=["kernel", "python"], autouse=True)
def _add_slots(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "python":
        monkeypatch.setattr(kernel, "present", kernel.Kernel(None))
    elif kernel.present.module is None:
        pytest.skip(kernel.present.problem)


def at(t_s: float, **values: Any) -> Sample:
    one = msgspec.structs.replace(sample(), accel_m_s2=None, gyro_rad_s=None, temperature_c=None)
    t_ns = round(t_s * S)
    known = {"seq": round(t_s * 1000), "t_ns": t_ns, "t_rx_ns": t_ns + 2000, "utc_ns": 10**18 + t_ns}
    return msgspec.structs.replace(one, **(known | values))


def kept(ledger: Ledger | None = None) -> History:
    return History(publisher_context(losses=lambda _name: (ledger or Ledger()).losses()).devices)


def made(*samples: Sample, device: str = "imu0", into: History | None = None) -> History:
    into = kept() if into is None else into
    for one in samples:
        into.add(Batch(device, 0, [one], FRAME))
    return into


def found(of: History, period_s: int = 1, limits: tuple[int, int] = HOUR) -> list[Bucket]:
    return list(buckets(of.seconds("imu0"), *limits, period_s, None))


def test_a_bucket_has_the_exact_minimum_and_maximum_of_its_second() -> None:
    """A value that is absent, not finite or too large for single precision does not count. UTC may step."""
    samples = [
        at(7.125, accel_m_s2=(1.0, -2.0, 3.0), temperature_c=20.5, sync="arrival"),
        at(7.25, accel_m_s2=(nan, 99.0, 99.0), quat_wxyz=(1.0, 0.0, 0.0, 0.0), t_err_ns=90_000, temperature_c=inf),
        at(7.5, accel_m_s2=(1e39, 99.0, 99.0), quat_wxyz=(1.0, nan, 0.0, 0.0), t_rx_ns=7_600_000_000),
        at(7.75, accel_m_s2=(-1.0, -0.5, 2.5), euler_rad=(0.5, 0.25, -3.0), pressure_pa=1e5),
        at(8.0, mag_t=(2.0**-20, 0.0, 0.0), utc_ns=5 * S),
        at(11.5, accel_m_s2=(4.0, 4.0, 4.0)),
    ]
    first, second, last = found(made(*samples))
    assert first == Bucket(
        7.125, 7.75, 10**9 + 7.75, 4, 7750, "regression", 9e-5, 0.1, accel_m_s2=((-1.0, -2.0, 2.5), (1.0, -0.5, 3.0)),
        euler_rad=((0.5, 0.25, -3.0), (0.5, 0.25, -3.0)), quat_wxyz=(1.0, 0.0, 0.0, 0.0), temperature_c=20.5,
        pressure_pa=1e5,
    )  # fmt: skip
    assert (second.count, second.utc_s, second.accel_m_s2) == (1, 5.0, None)
    assert second.mag_t == ((2.0**-20, 0.0, 0.0),) * 2
    assert (last.first_s, last.last_s) == (11.5, 11.5), "the gap has no bucket"
    (all_of_them,) = found(made(*samples), 100)
    assert all_of_them.accel_m_s2 == ((-1.0, -2.0, 2.5), (4.0, 4.0, 4.0))
    assert (all_of_them.count, all_of_them.seq, all_of_them.mag_t) == (6, 11500, second.mag_t)
    assert [one.first_s for one in found(made(*samples), 2, (7 * S, 11 * S))] == [7.125]


def test_batches_of_any_size_have_the_same_history() -> None:
    random = Random(1)
    samples = [
        at(100 + number / 40, **{name: tuple(random.gauss(0, 9) for _ in "xyz") for name in VECTORS})
        for number in range(500)
    ]
    single, large = made(*samples), kept()
    for begin in range(0, 500, 125):
        large.add(Batch("imu0", 0, samples[begin : begin + 125], FRAME))
    assert single.seconds("imu0") == large.seconds("imu0")
    assert [one.count for one in found(single)] == [40] * 12 + [20]
    for axis in range(3):
        values = [one.gyro_rad_s[axis] for one in samples[:40] if one.gyro_rad_s]
        low, high = found(single)[0].gyro_rad_s or ((), ())
        assert (low[axis], high[axis]) == pytest.approx((min(values), max(values)), rel=1e-7)


def test_a_second_has_the_losses_that_the_ledger_counted() -> None:
    """The sum over all seconds is the count of the ledger since the first sample."""
    ledger = Ledger()
    ledger.lost_crc = 7  # before the first sample
    of = made(*(at(1 + k / 100) for k in range(200)), into=kept(ledger))
    ledger.lost_crc, ledger.lost_queue = 9, 3
    made(*(at(3 + k / 100) for k in range(32)), into=of)
    ledger.lost_gap_device, ledger.lost_unknown = 4, 2
    made(*(at(4 + k) for k in range(3)), into=of)
    of.tick()  # without it, the losses of a slow device are late
    made(*(at(7 + k / 100) for k in range(100)), into=of)
    assert [(one.first_s, one.lost, one.gaps) for one in found(of)] == [
        (1, 0, 0), (2, 0, 0), (3, 5, 0), (4, 0, 0), (5, 0, 0), (6, 4, 2), (7, 0, 0),
    ]  # fmt: skip
    (all_of_them,) = found(of, 100)
    assert (all_of_them.lost, all_of_them.gaps) == (ledger.lost() - 7, ledger.lost_unknown)
    ledger.lost_crc, ledger.lost_queue = 0, 1 << 40  # another ledger; the record has 32 bits
    of.tick()
    made(*(at(7.99) for _ in range(16)), into=of)
    assert found(of)[-1].lost == (1 << 32) - 1
    packed = b"".join(Batch("imu0", 0, [at(7.995, mag_t=(1.0, 2.0, 3.0))], FRAME).packed for _ in range(3))
    seconds = [bytearray(of.seconds("imu0")[-SECOND.size :]) for _ in range(2)]
    by_kernel = getattr(kernel.load(None).module, "add_slots", history.add_slots)
    assert by_kernel(seconds[0], packed, 0) == history.add_slots(seconds[1], packed, 0) == 3 * 320
    assert (seconds[0], SECOND.unpack(seconds[0])[-2:]) == (seconds[1], ((1 << 32) - 1, 0))


@pytest.mark.parametrize("convention", Convention)
def test_a_convention_applies_to_the_limits(convention: Convention) -> None:
    samples = [
        at(1 + k / 8, accel_m_s2=(k, -1, 9), euler_rad=(k / 8, -0.25, 0.5 - k / 4), quat_wxyz=(0.6, 0, 0, 0.8))
        for k in range(4)
    ]
    rotation = FRAME.rotation_to(convention)
    assert rotation is not None
    (bucket,) = buckets(made(*samples).seconds("imu0"), *HOUR, 1, rotation)
    (wanted,) = found(made(*rotation.samples([msgspec.structs.replace(one, quat_wxyz=None) for one in samples])))
    for name in ("accel_m_s2", "euler_rad"):
        for side in (0, 1):
            assert getattr(bucket, name)[side] == pytest.approx(getattr(wanted, name)[side], abs=1e-6)
    assert bucket.quat_wxyz == pytest.approx(rotation.sample(samples[0]).quat_wxyz, abs=1e-6)
    assert bucket.gyro_rad_s is None


def test_the_history_ends_after_an_hour_or_at_the_limit_of_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    of = made(*(at(second) for second in range(10, 3700)))
    assert [found(of)[place].first_s for place in (0, -1)] == [99.0, 3699.0]
    made(at(7300.0), into=of)
    assert len(found(of)) == 3601, "3600 complete seconds and the open second"
    made(at(7301.0), into=of)
    assert [one.first_s for one in found(of)] == [7300.0, 7301.0]
    many = kept()
    for number in range(300):
        made(at(0.0), device=f"imu{number}", into=many)
    assert many.kept_s == (64 << 20) // (300 * SECOND.size)
    monkeypatch.setattr(history, "BYTES_MAX", 10 * SECOND.size)
    made(*(at(second, device="imu1") for second in range(50)), device="imu1", into=of)
    assert (of.kept_s, [len(of.seconds(name)) // SECOND.size for name in ("imu1", "imu2")]) == (5, [6, 0])
    made(at(3.0), at(4.0), into=of)  # another recording
    assert [one.first_s for one in found(of)] == [3.0, 4.0]
    of.remove("imu0")
    assert found(of) == []


def test_a_new_server_after_a_reload_continues_the_history() -> None:
    context = publisher_context()
    for has_history, continues in ((True, False), (True, True), (False, False), (True, False)):
        server = SocketServer(SocketOptions(history=has_history), context)
        server.add_device("imu0", 0)
        history = server.hub.history
        assert (history is not None) is has_history
        assert bool(history and history.seconds("imu0")) is continues
        server.publish(batch("imu0", 1, 100, 20_000_000))
    assert history is not None
    history.retain(["imu1"])
    assert history.seconds("imu0") == b""


@in_server()
async def test_the_method(server: SocketServer) -> None:
    peer = await Peer.greeted(server)
    assert (await peer.result("history", devices=["imu0"]))["devices"] == {"imu0": []}
    for first in range(1, 4000, 100):
        server.publish(batch("imu0", first, 100, 20_000_000))
    reply = await peer.result("history", devices=["imu0", "imu1"], points=10, convention="enu-flu")
    assert (reply["kept_s"], reply["devices"]["imu1"], reply["convention"]) == (3600, [], "enu-flu")
    assert sum(one["count"] for one in reply["devices"]["imu0"]) == 4000
    (only,) = (await peer.result("history", devices=["imu0"], points=1))["devices"]["imu0"]
    assert (only["count"], only["accel_m_s2"]) == (4000, [[0.125, -0.5, 9.75]] * 2)
    some = await peer.result("history", devices=["imu0"], from_ns=80_010 * S, to_ns=80_019 * S, points=5)
    assert [one["count"] for one in some["devices"]["imu0"]] == [100] * 5
    server.remove_device("imu0")
    server.add_device("imu0", 0)
    assert (await peer.result("history", devices=["imu0"]))["devices"] == {"imu0": []}
    names = [f"imu{number}" for number in range(5)]
    for number in (2, 3, 4):
        server.add_device(names[number], number)
    assert [*(await peer.result("history", devices=names[:4]))["devices"]] == names[:4]
    assert await peer.error("history", devices=names) == (-32602, "devices: expected at most 4 names, got 5")
    server.hub.history = None
    assert await peer.error("history", devices=["imu0"]) == (
        -32004, "history: the history is off; set `socket: {history: true}` in the configuration",
    )  # fmt: skip
