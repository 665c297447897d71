"""Output of `imud status` for a device."""

import json
from pathlib import Path
from time import monotonic_ns

from msgspec.structs import replace

from imud.cli.status import block, page
from imud.client.connection import Client
from imud.contracts.condition import Condition, DeviceCondition, Reason, ReasonCode
from imud.contracts.status import CKernelStatus, DeviceState, MqttStatus, WorkStatus
from imud.formats import kernel
from imud.model.units import NS_PER_S
from tests.cli.conftest import Cli
from tests.support.metrics import POLLING, device, equipped
from tests.support.socket_rig import daemon


def test_each_part_of_a_device_has_its_row_and_long_names_fit_80_columns_and_keep_both_ends() -> None:
    assert block(device("bow")).splitlines()[-1].startswith("  kernel ")
    identity = {"product": "IMU61x", "serial_number": "0032", "firmware": "10203", "hardware_version": "2"}
    lines = block(replace(device("bow"), identity=identity)).splitlines()
    at = lines.index("  identity  product IMU61x, serial_number 0032, firmware 10203, hardware_version")
    assert lines[at + 1] == "            2"
    assert "  identity  not known" in block(replace(device("bow"), identity={})).splitlines()
    assert block(device("front", polling=POLLING)).splitlines()[-2:] == [
        "  polling   1000 reads, 20 late, 3 missed, 4 stale, 5 failed; 70.0 µs after the",
        "            deadline, maximum 8000.0 µs; vanished 6 times",
    ]
    assert block(equipped("bow")).splitlines()[-12:] == [
        "  line      11 requests without a reply; 12 bytes without a request, 13 invalid",
        "            bytes; 14 echoes (all devices of the bus)",
        "  pulses    4998, 9 without a sample, 21 triggers without a frame; 17 samples", "            without a pulse",
        "  sout      5000 edges, 7 lost",
        "  alarm     ACTIVE, raised 3 times; 2 edges, 0 lost (/dev/gpiochip0 is not", "            there)",
        "  pps       60 edges, 0 lost",
        "  sin       400 triggers, 8 missed; 30.0 µs after the deadline, maximum 900.0 µs",
        "  utc       gpsd at 127.0.0.1:2947: 100 sentences, 90 sent, not sent: stale 7,",
        "            busy 3; 59 pulses, 1 ignored; sent to chronyd 40, refused 19",
        "            (chronyd does not take samples)",
    ]  # fmt: skip
    port = "/dev/serial/by-id/usb-Silicon_Labs_CP2102N_USB_to_UART_Bridge_Controller_7cb5c9f6a1e4e811-if00-port0"
    missing = device("n" * 32, link=f"{port} at 115200 baud", state=DeviceState.MISSING, problem=f"{port} is not there")
    lines = block(missing).splitlines()
    assert (max(map(len, lines)), lines[0]) == (80, f"{'n' * 32}: missing")
    assert lines[1].startswith("  /dev/serial/by-id/usb-Silicon")
    assert lines[1].endswith("-if00-port0")
    assert "…" in lines[1]
    assert lines[2] == "  is not there"


def test_json_is_all_that_the_socket_sends(tmp_path: Path, cli: Cli) -> None:
    with daemon(tmp_path) as served:
        with Client(served.path) as client:
            said = client.status()
        shown = json.loads(cli("status", "--socket", served.path, "--json").out)
        assert said["c_kernel"] == {"active": kernel.present.module is not None, "problem": kernel.present.problem}
        members = {"now_ns", "devices", "socket", "configuration", "mqtt", "outputs", "output_states", "c_kernel"}
        assert shown.keys() == said.keys() == members
        assert shown["devices"] == said["devices"]
        one = json.loads(cli("status", "--socket", served.path, "--json", "imu1").out)
        assert [device["name"] for device in one["devices"]] == ["imu1"]
        cli.refuses('that imud knows, got "imu9"', "status", "--socket", served.path, "imu1", "imu9")


def test_condition_with_reasons_and_problems_of_mqtt_and_the_kernel_in_c() -> None:
    reasons = Reason(ReasonCode.ALARM, "The ALARM pin is active.", "Look."), Reason(ReasonCode.LOST, "Lost.", "Step.")
    work = WorkStatus("the command save", monotonic_ns() - 600 * NS_PER_S, "uid 1000", "")
    degraded = device("mast", condition=DeviceCondition(Condition.ATTENTION, 0, reasons), work=work)
    text = page([degraded])
    assert text.startswith(
        "mast: attention\n  the command save is running, started 10 min ago by uid 1000\n"
        "  The ALARM pin is active. Look.\n  Lost. Step.\n  link   "
    )
    rows = [
        line[2:11].rstrip() for line in block(replace(degraded, ledger=dict.fromkeys(degraded.ledger, 0))).split("\n")
    ]
    assert ("times" in rows, {"rate", "clock", "latency"} & {*rows}) == (True, set())  # before the first sample
    old = replace(degraded, condition=None, problem="an old daemon", work=None)
    assert block(old).startswith("mast: running\n  an old daemon\n")
    mqtt = MqttStatus("", "no route", "", 0, 0, 0, 0, 0, 0, 0, {}, 0, refused={"a/b": "Not authorized"})
    assert page([], c_kernel=CKernelStatus(True)) == "C kernel: active"
    assert page([], [mqtt], {"metrics": "no IPv6"}, CKernelStatus(False, "no file")).splitlines() == [
        "mqtt: no route", "", "mqtt: the broker refuses messages of a/b: Not authorized", "", "metrics: no IPv6",
        "", "C kernel: not active: no file",
    ]  # fmt: skip
