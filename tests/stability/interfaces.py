"""Table of the interfaces of docs/stability.md: version, place of the version, and the facts that programs use."""

import argparse
import io
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stderr
from hashlib import sha256
from struct import Struct
from typing import Any, Final, NamedTuple
from unittest.mock import patch

import msgspec

from docs.generate.settings_parts import settings_parts
from docs.generate.socket_schema import socket_document
from imud import __version__, cli
from imud.attitude.conventions import Heading
from imud.bridges.channel import MessageChannel, MessageFrames
from imud.bridges.csv import EVENT_COLUMNS, LOSS_COLUMNS, sample_columns
from imud.bridges.json import JsonDialect
from imud.bridges.ros2 import Ros2Dialect, time_reference
from imud.cli import COMMANDS, build_parser
from imud.cli.arguments import CliCommand
from imud.cli.doctor import command as doctor
from imud.cli.doctor.surroundings import DoctorFinding
from imud.cli.events import PrintedEvent
from imud.cli.fleet_status import FleetReport, RejectedReport
from imud.cli.modbus import FoundModule
from imud.cli.probe import ProbeReport
from imud.cli.run import EXIT_CONFIGURATION, EXIT_INTERNAL, EXIT_OUTPUT
from imud.client import ring as ring_reader
from imud.contracts.command import CalibrationResult
from imud.contracts.firmware import FirmwareResult
from imud.contracts.registry import INTERFACE_VERSION
from imud.contracts.setting import AppliedSettings, SettingsReport
from imud.contracts.status import FlightStatus
from imud.drivers import DRIVERS
from imud.fleet import messages
from imud.fleet.accounts import GatewayState
from imud.fleet.database.settings import CollectorSettings
from imud.fleet.database.tables import SCHEMA_VERSION, TABLES, Column
from imud.fleet.database.views import views as database_views
from imud.fleet.metrics import COLLECTOR_METRICS, FLEET_METRICS
from imud.formats import jsonrpc, recording, records, ring, slot
from imud.formats.influx import event_fields, measure_fields, sample_fields
from imud.model.errors import ConfigError, ImudError
from imud.model.event import EventKind
from imud.model.ledger import LEDGER_FIELDS
from imud.model.sample import SAMPLE_FIELDS, SAMPLE_SCHEMA
from imud.publishers import PUBLISHERS
from imud.publishers.metrics import families
from imud.publishers.metrics.metric import Family, Histogram, Snapshot
from imud.publishers.metrics.publisher import Renderer
from imud.publishers.ros2.output import TYPE_HASHES
from imud.publishers.signalk.publisher import motion, surroundings
from imud.publishers.socket.methods import METHODS
from imud.publishers.vessel import HeadingReference
from imud.sim import CAN_SIMULATORS, SIMULATORS
from imud.utc.rmc_feed import Refusal
from tests.bridges.samples import EVENT, FULL
from tests.stability.facts import (
    INPUT,
    OUTPUT,
    REQUIRED,
    Facts,
    member_facts,
    module_facts,
    name_facts,
    schema_facts,
    type_facts,
)
from tests.support.files import ROOT
from tests.support.metrics import UTC, client, equipped, views


class Interface(NamedTuple):
    """An interface of docs/stability.md."""

    version: str
    place: str  # constant or key that contains the version
    read: str  # where a program reads the version
    facts: Callable[[], Facts]


def series(version: str) -> str:
    """Return the part of a version of imud that an incompatible change increments: 0.1 of 0.1.3, 1 of 1.2.3."""
    major, minor, *_ = version.split(".")
    return major if major != "0" else f"0.{minor}"


# --- configuration, socket, shared memory -----------------------------------------------------------------------------


def configuration() -> Facts:
    found = Facts()
    for title, path, schema in settings_parts():
        if title == "Link `memory`":  # only for tests of imud
            continue
        for name, text in type_facts(schema, path.rstrip("."), INPUT).items():
            if name:
                found.setdefault(name.removeprefix("."), text)
    for name, driver in DRIVERS.items():
        if driver.device_settings is not None:
            found |= type_facts(driver.device_settings.declarable, f"devices.NAME.settings ({name})", INPUT)
    return found


def socket() -> Facts:
    document = socket_document()
    components = document["$defs"]
    found = Facts()
    for message, schema in components.items():
        kind, _, name = message.partition(".")
        member = {"request": "params", "reply": "result", "notification": "params"}.get(kind)
        if name and member is not None:
            if message == "reply.error":
                found |= schema_facts(schema["properties"]["error"], components, "error", OUTPUT)
            else:
                words = INPUT if kind == "request" else OUTPUT
                found |= schema_facts(schema["properties"][member], components, message, words)
    found |= {f"method {name}": f"needs the right {method.right.name}" for name, method in METHODS.items()}
    found |= {f"error code {code.name}": str(int(code)) for code in jsonrpc.Code}
    found |= {f"field {f.name}": f"{f.type}, unit {f.unit!r}, frame {f.frame!r}" for f in SAMPLE_SCHEMA}
    found["path"] = jsonrpc.DEFAULT_PATH
    found["binary frame"] = f"length {jsonrpc.FRAME_HEADER.format}, slots of layout {slot.SLOT_LAYOUT_VERSION}"
    return found


def shared_memory() -> Facts:
    found = {"file": f"{ring.DIRECTORY}/{ring.FILE_PREFIX}DEVICE", "owner": f"uid {ring_reader.ROOT_UID} or directory"}
    for record, fields in (("slot", slot.SLOT_FIELDS), ("header", ring.HEADER_FIELDS)):
        for field in fields:
            if not field.name.startswith("reserved"):
                found[f"{record}.{field.name}"] = f"{field.count} of {field.code} at {field.offset}"
    for module, names in (
        (ring, ("MAGIC", "HEADER_BYTES", "HEARTBEAT_LIMIT_NS", "LEDGER_ROOM", "STATE_LIVE", "STATE_CLOSED")),
        (slot, ("SLOT_BYTES", "SEQ_INVALID", "CRC_OFFSET", "MORE_OFFSET", "NO_COUNT", "HAS_MORE")),
    ):
        found |= {name: str(getattr(module, name)) for name in names}
    found |= {f"present {name}": hex(bit) for name, bit in slot.PRESENT_BITS.items()}
    found |= {f"sync {sync}": str(code) for sync, code in slot.SYNC_CODES.items()}
    found |= {f"ledger {name}": str(place) for place, name in enumerate(LEDGER_FIELDS)}
    return found | c_header()


C_NAMES: Final = (
    re.compile(r"^#define (IMUD_\w+) (\S+)", re.MULTILINE),
    re.compile(r"\b(IMUD_\w+) = ([^,}/\n]+)"),
    re.compile(r"^static inline ([\w *]+?\b\w*[^_\W]\(.*\))$", re.MULTILINE),
)
"""Constants, values of enumerations, and functions without `_` at the end, which are private."""


def c_header() -> Facts:
    text = (ROOT / "imud/include/imud.h").read_text()
    versions = {"IMUD_LAYOUT_VERSION", "IMUD_SLOT_LAYOUT_VERSION"}
    constants, values, functions = (pattern.findall(text) for pattern in C_NAMES)
    members = re.search(r"typedef struct imud_ring \{(.*?)^\}", text, re.MULTILINE | re.DOTALL)
    assert members is not None
    found = {f"imud.h {name}": value for name, value in (*constants, *values) if name not in versions}
    found |= {f"imud.h {one}": "function" for one in functions}
    return found | {
        f"imud.h imud_ring.{one}": "member" for one in re.findall(r"\b(path|epoch|missed_total)\b", members[1])
    }


# --- Python -----------------------------------------------------------------------------------------------------------

READ_TYPES: Final = (
    ("imud.model.sample", "Sample"), ("imud.model.sample", "Position"), ("imud.model.sample", "Sync"),
    ("imud.model.event", "Event"), ("imud.model.event", "EventKind"), ("imud.model.bucket", "Bucket"),
    ("imud.formats.ring", "RingHeader"), ("imud.formats.ring", "LedgerBlock"),
)  # fmt: skip
"""Types of the values that `imud.client` and `imud.fleet` return."""


def python() -> Facts:
    found = module_facts("imud.client") | module_facts("imud.fleet") | module_facts("imud.sim")
    for module, name in READ_TYPES:
        found |= name_facts(module, name)
    # a program that reads does not create these objects, so a new field without a default is compatible
    found = {name: text.replace(f"{REQUIRED} field", "field") for name, text in found.items()}
    return found | module_facts("imud.model.errors")


def interface_modules() -> list[str]:
    """Return the modules in the table of docs/drivers.md, with the modules of each package."""
    _, _, table = (ROOT / "docs/drivers.md").read_text().partition("| module | stable contents |\n")
    found = []
    for name in re.findall(r"`(imud\.[a-z0-9_.]+)`", table.partition("\n\n")[0]):
        place = ROOT / name.replace(".", "/")
        found += [f"{name}.{file.stem}" for file in sorted(place.glob("[a-z]*.py"))] if name == "imud.model" else [name]
    return found


def drivers() -> Facts:
    found = Facts()
    for name in interface_modules():
        found |= module_facts(name)
    groups = (registry._group for registry in (DRIVERS, PUBLISHERS, SIMULATORS, CAN_SIMULATORS))
    return found | {f"entry points {one.name}": f"a {one.row_type.__name__}" for one in groups if one is not None}


# --- command line -----------------------------------------------------------------------------------------------------

JSON_OF: Final[Mapping[str, type]] = {
    "imud calibrate --json": CalibrationResult,
    "imud doctor --json: checks.findings": DoctorFinding,
    "imud events --json": PrintedEvent,
    "imud firmware --json": FirmwareResult,
    "imud fleet rejected --json": RejectedReport,
    "imud fleet status --json": FleetReport,
    "imud modbus scan --json": FoundModule,
    "imud probe --json": ProbeReport,
    "imud settings --json": SettingsReport,
    "imud settings --set --json": AppliedSettings,
}
"""Printed objects. `clock`, `status` and `watch` print objects of the socket."""
MEMBERS_OF: Final = {
    "imud decode": ("imud.cli.decode", ("as_object",)),
    "imud doctor --json": ("imud.cli.doctor.command", ("as_json",)),
    "imud info --json": ("imud.cli.record", ("summary",)),
    "imud noise --json": (
        "imud.cli.noise", ("as_object", "measurement_object", "grid_object", "_sensor_object", "_axis_object"),
    ),
    "imud schema --json": ("imud.cli.schema", ("run",)),
    "imud setup --json": ("imud.cli.setup.steps", ("SetupSteps.as_json",)),
    "imud spectrum --json": ("imud.cli.spectrum", ("as_object", "_sensor_object")),
}  # fmt: skip
"""Printed objects without a type: module and functions that make them."""


def command_line() -> Facts:
    with patch.dict("os.environ"):
        for name in ("IMUD_SOCKET", "IMUD_SHM", "XDG_RUNTIME_DIR", "COLUMNS"):
            os.environ.pop(name, None)
        found = dict(_parser_facts(build_parser(), "imud"))
    for name, kind in JSON_OF.items():
        found |= type_facts(kind, name, OUTPUT)
    for name, (module, functions) in MEMBERS_OF.items():
        for function in functions:
            found |= member_facts(module, function, name)
    for driver in DRIVERS.values():
        found |= {f"calibration ({driver.name}) {kind}": "calibration" for kind in driver.calibrations}
        for verb, one in driver.verbs.items():
            found |= type_facts(one.parameters, f"command ({driver.name}) {verb}", INPUT)
    sources = "".join(file.read_text() for file in (ROOT / "imud").rglob("*.py"))
    return found | {f"variable {name}": "read" for name in set(re.findall(r'"(IMUD_[A-Z]+)"', sources))}


def _parser_facts(parser: argparse.ArgumentParser, path: str) -> Iterator[tuple[str, str]]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, inner in action.choices.items():
                yield f"{path} {name}", "command"
                yield from _parser_facts(inner, f"{path} {name}")
            continue
        values = action.nargs if action.nargs is not None else 1
        default = "" if action.default in (None, False, argparse.SUPPRESS) else f", default {action.default}"
        # Python before 3.14: `required` is set for arguments with any number of values
        word = REQUIRED if action.required and values != "*" else "optional"
        for name in action.option_strings or [str(action.metavar or action.dest)]:
            yield f"{path} {name}", f"{word}, values {values}{default}"
            for choice in action.choices or ():
                yield f"{path} {name}: {choice}", "value"


RAISED: Final[Mapping[str, BaseException | int]] = {
    "the command succeeded": 0,
    "the result is negative": 1,
    "the command could not run": ImudError("x"),
    "invalid configuration of another command than run": ConfigError("x"),
    "a file or the output failed": OSError(28, "x"),
    "the reader of the output ended": BrokenPipeError(),
    "Ctrl-C": KeyboardInterrupt(),
}
"""Ends of a command, each with an example."""


def exit_statuses() -> Facts:
    found = {f"imud run: {name}": str(value) for name, value in RUN_STATUSES.items()}
    found |= {f"imud doctor, worst severity {severity}": str(status) for severity, status in doctor.STATUS.items()}
    return found | {words: str(_status_of(end)) for words, end in RAISED.items()} | {"wrong arguments": _refused()}


RUN_STATUSES: Final = {
    "internal error": EXIT_INTERNAL,
    "a required output cannot start": EXIT_OUTPUT,
    "invalid configuration": EXIT_CONFIGURATION,
}


def _status_of(end: BaseException | int) -> int:
    """Return the exit status of a command with this end."""

    def run(_args: argparse.Namespace) -> int:
        if isinstance(end, BaseException):
            raise end
        return end

    class Row(NamedTuple):
        help: str = ""

        def load(self) -> CliCommand:
            return CliCommand(lambda _parser: None, run)

    with patch.dict(COMMANDS, {"schema": Row()}), redirect_stderr(io.StringIO()), patch.object(cli, "discard_output"):
        return cli.main(["schema"])


def _refused() -> str:
    try:
        with redirect_stderr(io.StringIO()):
            return str(cli.main(["schema", "--no-such-option"]))
    except SystemExit as end:
        return str(end.code)


# --- metrics, files, messages -----------------------------------------------------------------------------------------


def metrics() -> Facts:
    found = Facts()
    for name, table in vars(families).items():
        for one in (table if isinstance(table, tuple) else ()) if name.endswith("FAMILIES") else ():
            if isinstance(one, Family):
                found[one.name] = f"{one.type.value}, labels {', '.join(one.reader.labels) or 'none'}"
            elif isinstance(one, Histogram):
                bounds = " ".join(map(str, one.bounds_ns))
                found[one.name] = f"histogram, labels device, bounds {bounds} ns"
    for metric in (*COLLECTOR_METRICS, *FLEET_METRICS):
        found[metric.name] = f"{metric.type.value}, labels {', '.join(metric.labels) or 'none'}"
    refused = msgspec.structs.replace(UTC, refused={one.value: 0 for one in Refusal})
    snapshot = Snapshot(
        (equipped("NAME", utc=refused),), (client(1),), tuple((("NAME", kind.value), 1) for kind in EventKind),
        views=views("NAME"), flights=(FlightStatus("", *range(8)),),
    )  # fmt: skip
    page = Renderer(pause=lambda: None).render(snapshot, "").body.decode()
    types = re.findall(r"^# TYPE (process_\w+) (\w+)", page, re.MULTILINE)
    for name, pairs in re.findall(r"^(imud_\w+)\{(.*)\}", page, re.MULTILINE):
        labels = [pair for pair in re.findall(r'(\w+)="([^"]*)"', pairs) if pair[0] in CLOSED]
        found |= {f"{name} {label}: {value}": "value" for label, value in labels}
    return found | {name: f"{kind}, labels none" for name, kind in types}


CLOSED: Final = frozenset(
    {"angle", "axis", "cause", "condition", "encoding", "fate", "kind", "reason", "result", "state", "sync"}
)
"""Labels with a set of values that imud defines."""

RECORDS: Final = (
    records.SessionRecord, records.DeviceRecord, records.PathRecord, records.CallRecord, records.CheckRecord,
    records.EndRecord,
)  # fmt: skip


def recordings() -> Facts:
    found = {"magic": recording.MAGIC.hex(), "methods": f"{recording.STORED}, {recording.ZSTANDARD}"}
    for module in (recording, records):
        for name, one in vars(module).items():
            if isinstance(one, Struct) and name != "_DATA_WHOLE":
                found[f"layout {module.__name__.rpartition('.')[2]}.{name.strip('_').lower()}"] = one.format
    found |= {f"kind {kind.name}": str(int(kind)) for kind in records.Kind}
    found |= {f"line {name}": str(place) for place, name in enumerate(records.LINES)}
    for kind in RECORDS:
        found |= type_facts(kind, kind.__name__.removesuffix("Record").upper(), OUTPUT)
    return found


def mqtt() -> Facts:
    leaves = [*messages.Stream, messages.STATUS, messages.SCHEMA, messages.SETTINGS, messages.COMMAND, messages.ANSWER]
    topics = {
        *(messages.topic_of("SITE", "GATEWAY", "DEVICE", leaf) for leaf in leaves),
        *(messages.topic_of("SITE", "GATEWAY", "", leaf) for leaf in (messages.STATE, messages.Stream.EVENTS)),
    }
    found = {f"topic {name}": "topic" for name in topics}
    found |= type_facts(messages.FleetMessage, "message", OUTPUT)
    found |= type_facts(GatewayState, "state", OUTPUT)
    found |= type_facts(messages.CommandRequest, "request", INPUT)
    found |= type_facts(messages.CommandAnswer, "answer", OUTPUT)
    for topic, function in (("state", "MqttPublisher._state"), ("schema", "schema_of"), ("settings", "settings_of")):
        found |= member_facts("imud.fleet.publisher", function, f"written {topic}")
    found["slots"] = f"{messages.MAGIC!r}, layout {messages._PREFIX.format}, {messages.SLOTS_TYPE}"
    return found | {f"slots of version {version}": f"{size} bytes" for version, size in messages._SLOT_BYTES.items()}


UNIT: Final = re.compile(r", (ns since 1970|ns|ms|s|bytes|m/s²|rad/s|rad|m/s|m|T|°C|Pa)(?=[;-]|$)")
"""Unit in the comment of a column."""


def database() -> Facts:
    found = {f"{one.name}, primary key": ", ".join(one.primary) for one in TABLES if one.primary}
    views = database_views(with_timescale=False)
    found |= {f"{one.function}(since timestamptz, until timestamptz)": one.name for one in views if one.function}
    parts = [(one.name, one.columns) for one in TABLES]
    parts += [(one.name, one.columns) for one in views]
    return found | {f"{name}.{one.name}": _column_fact(one) for name, columns in parts for one in columns}


def _column_fact(column: Column) -> str:
    unit = UNIT.search(column.comment)
    return f"{column.type}, {unit[1]}" if unit is not None else column.type


def collector_configuration() -> Facts:
    facts = type_facts(CollectorSettings, "", INPUT)
    return {name.removeprefix("."): text for name, text in facts.items() if name}


def other_outputs() -> Facts:
    """Return the names in exported files, InfluxDB, and messages for other programs."""
    found = {f"csv samples {name}": "column" for name in sample_columns(SAMPLE_FIELDS)}
    found |= {f"csv events {name}": "column" for name in EVENT_COLUMNS}
    found |= {f"csv losses {name}": "column" for name in LOSS_COLUMNS}
    frames = MessageFrames("NAME")
    for dialect in (JsonDialect(), Ros2Dialect()):
        kind = dialect.profile or "json"
        channels: list[MessageChannel[Any]] = [
            *dialect.samples(frames), dialect.losses("NAME"), dialect.events(), dialect.diagnostics(),
        ]  # fmt: skip
        for one in channels:
            found[f"mcap {kind} {one.topic}"] = one.schema.name
            if one.schema.encoding == "jsonschema":
                document = msgspec.json.decode(one.schema.data)
                found |= schema_facts(document, document.get("$defs", {}), f"mcap {one.schema.name}", OUTPUT)
            else:
                found[f"mcap {one.schema.name}"] = f"definition {sha256(one.schema.data).hexdigest()[:16]}"
    topics: list[MessageChannel[Any]] = [
        *Ros2Dialect().samples(frames), time_reference(frames), Ros2Dialect().diagnostics(),
    ]  # fmt: skip
    hashes = {f"ros2 {one.topic}": TYPE_HASHES.get(one.schema.name) for one in topics}
    found |= {name: one for name, one in hashes.items() if one is not None}
    found |= {f"influx imud_sample {name}": type(value).__name__ for name, value in sample_fields(FULL)}
    found |= {f"influx imud_event {name}": "field" for name, _ in event_fields(EVENT)}
    found |= {f"influx imud_ledger {name}": "field" for name in LEDGER_FIELDS}
    found |= {
        f"influx imud_interval {name}": "field" for name, _ in measure_fields("euler_rad", "mean", FULL.euler_rad or ())
    }
    sources = "".join(
        (ROOT / f"imud/{name}.py").read_text() for name in ("fleet/influx", "publishers/influx/publisher")
    )
    found |= {f"influx {name}": "measurement" for name in re.findall(r'"(imud_[a-z]+)"', sources)}
    for heading in (Heading.TRUE, Heading.MAGNETIC):
        reference = HeadingReference(heading, 3.0)
        paths = [*motion(FULL, reference), *surroundings(FULL, reference)]
        found |= {f"signalk {path}": type(value).__name__ for path, value in paths}
    return found


_SERIES: Final = series(__version__)
_RELEASE: Final = "`version` in pyproject.toml and `__version__` in imud/__init__.py"
_OF_IMUD: Final = "`imud --version`: the first two numbers"

INTERFACES: Final[Mapping[str, Interface]] = {
    "configuration": Interface(_SERIES, _RELEASE, _OF_IMUD, configuration),
    "collector-configuration": Interface(_SERIES, _RELEASE, _OF_IMUD, collector_configuration),
    "socket": Interface(
        str(jsonrpc.PROTOCOL), "PROTOCOL in imud/formats/jsonrpc.py", "`protocol` of the notification `hello`", socket
    ),
    "shared-memory": Interface(
        f"{ring.RING_LAYOUT_VERSION}, {slot.SLOT_LAYOUT_VERSION}",
        "RING_LAYOUT_VERSION in imud/formats/ring.py (header) or SLOT_LAYOUT_VERSION in imud/formats/slot.py (slot)",
        "`layout_version` and `slot_layout_version` of the header",
        shared_memory,
    ),
    "python": Interface(_SERIES, _RELEASE, "`imud.__version__`: the first two numbers", python),
    "command-line": Interface(_SERIES, _RELEASE, _OF_IMUD, command_line),
    "exit-statuses": Interface(_SERIES, _RELEASE, _OF_IMUD, exit_statuses),
    "metrics": Interface(_SERIES, _RELEASE, "label `version` of `imud_build_info`: the first two numbers", metrics),
    "recordings": Interface(
        str(records.VERSION), "VERSION in imud/formats/records.py", "`version` of the record `session`", recordings
    ),
    "mqtt": Interface(
        str(messages.VERSION), "VERSION in imud/fleet/messages.py", "`v` of each stream message, state and reply", mqtt
    ),
    "database": Interface(
        str(SCHEMA_VERSION), "SCHEMA_VERSION in imud/fleet/database/tables.py", "`version` in the table `imud_schema`",
        database,
    ),
    "other-outputs": Interface(_SERIES, _RELEASE, _OF_IMUD, other_outputs),
    "drivers": Interface(
        str(INTERFACE_VERSION), "INTERFACE_VERSION in imud/contracts/registry.py",
        "`imud.contracts.registry.INTERFACE_VERSION`", drivers,
    ),
}  # fmt: skip
