"""Complete output: selected devices, rates, tags, ledgers, events; every sample in a real InfluxDB."""

import socket
from pathlib import Path
from typing import Any

import msgspec
import pytest

from imud.contracts.publisher import Batch
from imud.host.threads import Job
from imud.model.event import Event, EventKind
from imud.model.ledger import LEDGER_FIELDS
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_MS, NS_PER_S
from imud.publishers.influx.publisher import InfluxOutput
from imud.publishers.influx.settings import InfluxOptions
from tests.support.daemon_process import wait_until
from tests.support.event_loops import UTC_AHEAD_NS, VirtualClock
from tests.support.line_protocol import NO_INFLUX, InfluxServer, Parsed, influx_server, parse_line
from tests.support.publisher_context import FakeLatencies, publisher_context


class PromptWorker:
    """Worker whose job runs in the thread of the caller, at each `ring`."""

    def __init__(self, _name: str, job: Job) -> None:
        self._job = job
        self.ring()

    def ring(self) -> None:
        while not self._job.do_round():
            pass

    def end(self) -> bool:
        return True


class Rig:
    def __init__(self, to: dict[str, Any], *, prompt: bool = True, **settings: Any) -> None:
        self.clock, self.asked = VirtualClock(), FakeLatencies()
        self.context = publisher_context(
            now_ns=self.clock.now_ns, latencies=self.asked, utc_offset_ns=lambda: UTC_AHEAD_NS,
            ledgers=lambda: [(name, "hipnuc-uart", tuple(range(len(LEDGER_FIELDS)))) for name in ("bow", "mast")],
        )  # fmt: skip
        options = msgspec.convert({"enabled": True, "to": to, **settings}, InfluxOptions)
        more: dict[str, Any] = {"start_worker": PromptWorker} if prompt else {}
        self.output = InfluxOutput(options, self.context, host_name=lambda: "gw-17.example", **more)
        for number, name in enumerate(("bow", "mast")):
            self.output.add_device(name, number)
        self.output.start()
        self.seq = 0

    def publish(self, count: int, device: str = "bow", step_ns: int = NS_PER_MS) -> None:
        samples = []
        for _ in range(count):
            self.clock.advance(step_ns)
            self.seq += 1
            t_ns = self.clock.now_ns()
            samples.append(
                Sample(
                    device,
                    self.seq,
                    t_ns,
                    500,
                    Sync.EDGE,
                    t_ns,
                    t_ns + UTC_AHEAD_NS,
                    accel_m_s2=(self.seq / 8, 0.0, 9.75),
                )
            )
        self.output.publish(Batch(device, 0, samples))

    def end(self, seconds: float = 1) -> None:
        self.clock.advance(round(seconds * NS_PER_S))
        self.output.tick(self.clock.now_ns())
        self.output.close()


def lines_of(path: Path, measurement: str) -> list[Parsed]:
    found = [parse_line(one) for one in path.read_text().splitlines(keepends=True)]
    return [one for one in found if one.measurement == measurement]


def test_samples_ledgers_and_events_of_the_selected_devices(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    rig = Rig({f"file://{path}": {}}, devices=["bow"], rate_hz=None, site="mill")
    rig.publish(3)
    rig.publish(3, "mast")
    t_ns = rig.clock.now_ns()
    for event in (
        Event(t_ns, "bow", EventKind.UP, "up"),
        Event(t_ns, "mast", EventKind.UP, "no"),
        Event(t_ns, "", EventKind.UP, "x"),
    ):
        rig.output.event(event)
        rig.output.event(event)
    assert rig.asked.asked == {"influx": (NS_PER_S // 10, ("bow",))}
    (status,) = rig.context.outputs.ports["influx"]()
    assert (status.name, status.sent, status.problem) == (f"file://{path}", 0, "")
    rig.end()
    tags = {"site": "mill", "gateway": "gw-17", "device": "bow"}
    begin_ns = t_ns - 6 * NS_PER_MS + UTC_AHEAD_NS
    samples = lines_of(path, "imud_sample")
    assert [(one.tags, one.time_ns, one.fields["seq"]) for one in samples] == [
        (tags, begin_ns + number * NS_PER_MS, number) for number in (1, 2, 3)
    ]  # fmt: skip
    assert samples[0].fields["accel_m_s2_x"] == 0.125
    (ledger,) = lines_of(path, "imud_ledger")
    assert ledger.tags == tags
    assert ledger.fields == {name: number for number, name in enumerate(LEDGER_FIELDS)}
    events = [(one.tags.get("device"), one.fields["message"], one.time_ns) for one in lines_of(path, "imud_event")]
    now_ns = t_ns + UTC_AHEAD_NS
    assert events == [("bow", "up", now_ns), ("bow", "up", now_ns + 1), (None, "x", now_ns), (None, "x", now_ns + 1)]
    assert rig.asked.asked == {}
    assert "influx" not in rig.context.outputs.ports


def test_rate_and_interval_of_ledgers(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    rig = Rig({f"file://{path}": {}}, rate_hz=10, gateway="other", ledger_s=2)
    for _ in range(50):
        rig.publish(20, "mast", 5 * NS_PER_MS)
        rig.output.tick(rig.clock.now_ns())
    rig.output.remove_device("mast")
    rig.publish(20, "mast")
    assert rig.asked.asked["influx"][1] == ("bow",)
    rig.output.remove_device("bow")
    assert rig.asked.asked == {}
    rig.end(0)
    samples = lines_of(path, "imud_sample")
    assert [one.fields["seq"] for one in samples] == list(range(1, 1000, 20))
    assert {one.tags["gateway"] for one in samples} == {"other"}
    assert [one.tags["device"] for one in lines_of(path, "imud_ledger")] == ["bow", "mast"] * 3


@pytest.mark.live
@pytest.mark.skipif(bool(NO_INFLUX), reason=NO_INFLUX)
def test_influxdb_stores_each_sample_once_despite_its_restart(tmp_path: Path) -> None:
    with influx_server(tmp_path) as server:
        rig = Rig({server.url: {}}, prompt=False, rate_hz=None, batch_s=0.1)
        (destination,) = rig.output.destinations

        def acknowledged(count: int) -> None:
            rig.clock.advance(NS_PER_S)
            rig.output.tick(rig.clock.now_ns())
            wait_until(lambda: destination.account().acknowledged >= count, f"{count} lines are acknowledged")

        rig.publish(500)
        rig.output.event(Event(rig.clock.now_ns(), "bow", EventKind.UP, 'a "b" \\ c, d=e', {"x": 'y"\n', "n": 1}))
        acknowledged(501)
        server.kill()
        rig.publish(500)
        rig.clock.advance(NS_PER_S)
        rig.output.tick(rig.clock.now_ns())
        wait_until(lambda: destination.status().problem != "", "the failure is reported")
        server.start()
        rig.clock.advance(60 * NS_PER_S)
        rig.output.event(Event(rig.clock.now_ns(), "", EventKind.UP, "again"))
        acknowledged(1002)
        rig.end()
        account = destination.account()
        assert account.made == account.acknowledged >= 1002
        rows = server.query("SELECT * FROM imud_sample")
        assert [row["seq"] for row in rows] == list(range(1, 1001))
        assert [row["accel_m_s2_x"] for row in rows] == [seq / 8 for seq in range(1, 1001)]
        assert {(row["device"], row["gateway"], row["sync"]) for row in rows} == {("bow", "gw-17", "edge")}
        assert rows[0]["time"] == rows[0]["t_ns"] + UTC_AHEAD_NS
        first, _ = server.query("SELECT * FROM imud_event")
        assert (first["message"], first["detail"]) == ('a "b" \\ c, d=e', r'{"x":"y\"\n","n":1}')
        by_udp(server)


def by_udp(server: InfluxServer) -> None:
    rig = Rig({f"udp://127.0.0.1:{server.udp_port}": {}}, rate_hz=None, site="udp")
    rig.publish(20)
    rig.end()
    wait_until(lambda: len(server.query("SELECT seq FROM imud_sample WHERE site = 'udp'")) == 20, "20 rows arrive")


def test_the_host_name_is_the_default_gateway() -> None:
    options = msgspec.convert({"to": {}}, InfluxOptions)
    assert InfluxOutput(options, publisher_context())._tags["gateway"] == socket.gethostname().partition(".")[0]
