"""Rules for the whole tree: direction of imports, names, reads of the clock, and the place of each test module.

A module imports only from its own layer of LAYERS and from the layers above it, type-only imports included. Each test
checks all files and reports all violations together.
"""

import ast
import re
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "imud"

LAYERS: tuple[tuple[str, ...], ...] = (
    ("imud", "imud.units"),
    ("imud.sample", "imud.errors", "imud.ledger", "imud.event"),
    ("imud.attitude", "imud.files", "imud.host_clock", "imud.log", "imud.notify", "imud.permissions", "imud.worker"),
    ("imud.frames",),
    ("imud.formats",),
    ("imud.contracts", "imud.frames.settings"),
    ("imud.devices", "imud.clock", "imud.links", "imud.publishers", "imud.utc"),
    ("imud.sim", "imud.config", "imud.client", "imud.analysis", "imud.bridges", "imud.fleet"),
    ("imud.web",),
    ("imud.signals",),
    ("imud.runtime",),
    ("imud.reload",),
    ("imud.daemon",),
    ("imud.cli", "imud.__main__"),
)
LEAVES_LAYER = next(number for number, names in enumerate(LAYERS) if "imud.devices" in names)
LEAVES = LAYERS[LEAVES_LAYER]
PURE = ("imud.devices.", "imud.clock.", "imud.analysis.")
IO_MODULES = {
    "asyncio", "fcntl", "io", "os", "pathlib", "select", "serial", "socket", "subprocess", "termios", "threading",
    "time",
}  # fmt: skip


def modules() -> dict[str, Path]:
    """Every module of the package by name."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = ("imud", *path.relative_to(PACKAGE).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


@cache
def tree_of(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    return ast.parse(path.read_text())


@cache
def imports(path: Path) -> frozenset[str]:
    """Full names of everything that a module imports, at any depth of its code."""
    found: set[str] = set()
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            base = node.module or ""
            for alias in node.names:
                full = f"{base}.{alias.name}"
                found.add(full if full in MODULES else base)
    return frozenset(found)


def layer_of(module: str) -> int:
    """Number of the layer that a module belongs to, by the longest matching prefix."""
    best, number = "", -1
    for index, names in enumerate(LAYERS):
        for name in names:
            if (module == name or (module.startswith(name + ".") and name != "imud")) and len(name) > len(best):
                best, number = name, index
    assert number >= 0, f"{module} is in no layer; add its package to LAYERS"
    return number


def own_imports(module: str) -> frozenset[str]:
    """Return the modules of imud that a module imports."""
    return imports(MODULES[module]) & MODULES.keys()


def part_of(module: str, parts: tuple[str, ...]) -> str | None:
    """Return the part that contains a module; None if no part contains it."""
    return next((part for part in parts if module == part or module.startswith(part + ".")), None)


def test_no_module_imports_from_a_later_layer() -> None:
    wrong = [
        f"{module} imports {target}"
        for module in MODULES
        for target in own_imports(module)
        if layer_of(target) > layer_of(module)
    ]
    assert not wrong, wrong


def test_leaves_do_not_import_each_other() -> None:
    wrong = [
        f"{module} imports {target}"
        for module in MODULES
        if layer_of(module) == LEAVES_LAYER
        for target in own_imports(module)
        if layer_of(target) == LEAVES_LAYER and part_of(target, LEAVES) != part_of(module, LEAVES)
    ]
    assert not wrong, wrong


def test_codecs_clock_and_analysis_do_no_io() -> None:
    wrong = {
        module: used
        for module in MODULES
        if module.startswith(PURE)
        and (used := {name.partition(".")[0] for name in imports(MODULES[module])} & IO_MODULES)
    }
    assert not wrong, wrong


def test_there_is_no_import_cycle() -> None:
    graph = {name: sorted(imports(path) & MODULES.keys() - {name}) for name, path in MODULES.items()}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, f"import cycle: {' → '.join([*trail[trail.index(name) :], name])}"
        if name not in done:
            for target in graph[name]:
                visit(target, (*trail, name))
            done.add(name)

    for name in graph:
        visit(name, ())


ANALYSIS = ("imud.analysis", "imud.cli.analysis")
HEAVY = {"numpy", "scipy", "matplotlib"}


def test_only_the_analysis_imports_its_extra() -> None:
    wrong = [
        f"{module} imports {name}"
        for module, path in MODULES.items()
        if not module.startswith(ANALYSIS)
        for name in imports(path)
        if name.partition(".")[0] in HEAVY or name.startswith(ANALYSIS)
    ]
    assert not wrong, wrong


def test_only_one_module_imports_gpiod() -> None:
    assert {m for m in MODULES if "gpiod" in imports(MODULES[m])} <= {"imud.signals.gpio.chips"}


# --- names -----------------------------------------------------------------------------------------------------------


def own_modules() -> dict[str, Path]:
    """Modules that are files of their own: neither a package's `__init__` nor the entry point of a program."""
    return {name: path for name, path in MODULES.items() if path.name not in ("__init__.py", "__main__.py")}


def test_public_class_names_stand_once() -> None:
    owners: dict[str, list[str]] = {}
    for module, path in MODULES.items():
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                owners.setdefault(node.name, []).append(module)
    twice = {name: where for name, where in owners.items() if len(where) > 1}
    assert not twice, twice


# --- time is an argument ----------------------------------------------------------------------------------------------

CLOCKS = {
    "clock_gettime", "clock_gettime_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "time",
    "time_ns",
}  # fmt: skip
NOW = {"now", "today", "utcnow"}
MAY_READ_CLOCKS = (
    "imud.daemon",
    "imud.host_clock",
    "imud.cli",  # programs of their own, as are the client and the simulator's process
    "imud.client",
    "imud.fleet.reader",
    "imud.sim.__main__",
    "imud.links",  # in the callback that reads, and in waits for the wire
    "imud.runtime.event_loop",  # how long it still waits, by the clock of asyncio's timers
)


def clock_uses(path: Path) -> list[str]:
    """Every place that reads a clock, or names a clock function as a default."""
    found = []
    tree = tree_of(path)
    named = {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and node.module == "time"
        for alias in node.names
        if alias.name in CLOCKS
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id in named:
            found.append(f"{node.lineno}: {node.id}")
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name | ast.Call):
            owner = ast.unparse(node.value)
            if (owner == "time" and node.attr in CLOCKS) or (owner.endswith("datetime") and node.attr in NOW):
                found.append(f"{node.lineno}: {owner}.{node.attr}")
            elif node.attr == "time" and "loop" in owner:
                found.append(f"{node.lineno}: {owner}.time")
    return found


def may_read_clocks(module: str) -> bool:
    """Whether the module, or a package that it is in, may."""
    return any(module == name or module.startswith(name + ".") for name in MAY_READ_CLOCKS)


def test_time_is_an_argument() -> None:
    wrong = {m: uses for m, path in MODULES.items() if not may_read_clocks(m) and (uses := clock_uses(path))}
    assert not wrong, wrong


def test_the_search_for_clocks_finds_them(tmp_path: Path) -> None:
    file = tmp_path / "module.py"
    file.write_text(
        "import asyncio, time\nfrom datetime import datetime\nfrom time import monotonic_ns as now\n"
        "a = time.time_ns()\nb = now()\nc = datetime.now()\nd = asyncio.get_running_loop().time()\n"
        "def f(now_ns=time.monotonic_ns): time.sleep(1); return now_ns()\n"
    )
    lines = sorted(int(use.partition(":")[0]) for use in clock_uses(file))
    assert lines == [4, 5, 6, 7, 8]


# --- tests ------------------------------------------------------------------------------------------------------------


def private_writes(path: Path) -> list[str]:
    """Every place where a test sets an underscore member of another object, or patches one by name."""
    if not re.search(r"[.\"']_[a-z]", path.read_text()):
        return []  # most files: parsing them takes seconds
    found = []
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Assign | ast.AugAssign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            attributes = [target for target in targets if isinstance(target, ast.Attribute)]
            others = [a for a in attributes if is_private(a.attr) and ast.unparse(a.value) != "self"]
            found += [f"{node.lineno}: {ast.unparse(a)}" for a in others]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("setattr"):
            words = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
            found += [f"{node.lineno}: {word}" for word in words if is_private(word.rpartition(".")[2])]
    return found


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


TESTS = Path(__file__).parent


def test_tests_write_no_private_members() -> None:
    wrong = {path: writes for path in sorted(TESTS.rglob("*.py")) if (writes := private_writes(path))}
    assert not wrong, wrong


# --- a test by the path of its module ---------------------------------------------------------------------------------

ELSEWHERE = (
    "audit",
    "bench",
    "lab",
    "lab_debian",
    "include",
    "fuzz",
    "attack",
    "support",
    "packaging",
    "monitoring",
)
"""Folders of tests that mirror no package: measurements, kernels, the C header, foreign bytes, helpers, packages, and
what Prometheus makes of the metrics."""

CROSS_CUTTING = {
    "cli/recording/test_snapshot.py": "the flight recorder in a daemon, its command, and the replay of what it saves",
    "publishers/recorder/test_kills.py": "daemons that record and are killed",
    "test_architecture.py": "the tree itself",
    "test_docs.py": "README.md, docs, Makefile",
    "test_daemon_signals.py": "the daemon as a process: log, reload, kill",
    "test_end_to_end.py": "the daemon as a process, with its clients",
    "clock/test_steered_host.py": "the whole clock on hosts whose clocks are slewed, stepped, suspended or stopped",
    "publishers/shm/test_hostile.py": "the directory of the rings against other users",
    "cli/foxglove/test_physics.py": "`imud foxglove`, a daemon and a simulated module, by a client of the protocol",
    "cli/test_main.py": "`main` of imud/cli/__init__.py",
    "clock/test_accuracy.py": "every part of the clock against the truth of a simulation",
    "clock/test_clock_table.py": "the stated error in cells of the table of adversities",
    "devices/test_every_row.py": "the rows, calibrations and data sheets of every driver",
    "devices/test_every_stream_driver.py": "every driver of byte streams",
    "devices/test_every_can_driver.py": "every driver on CAN",
    "devices/test_every_polled_driver.py": "every driver that is polled",
    "devices/test_every_device_settings.py": "the settings of every driver",
    "devices/hipnuc/test_moves_and_settings_on_can.py": "settings and moves of the drivers on CAN",
    "devices/hipnuc/canopen/test_peers.py": "the canopen library as a peer of codec and simulator",
    "devices/imu61x/test_one_truth.py": "one motion through every protocol of the family",
    "links/can/test_failed_steps.py": "every step after the opening of a CAN link",
    "links/rs485/test_modbus_peers.py": "pymodbus as a peer of link and simulator",
    "publishers/mqtt/test_faults.py": "the output mqtt, a real broker and a collector, with faults",
    "publishers/socket/test_command.py": "`command` through connection, rights and RPC",
    "publishers/socket/test_documentation.py": "docs/protocol.md",
    "publishers/socket/test_latency.py": "what latency clients ask for, through RPC and hub",
    "runtime/detection/test_stream_families.py": "every driver in one search",
    "runtime/latency/test_same_samples.py": "the paths of every driver, with and without a wait",
    "runtime/polled/test_in_daemon.py": "a bus thread in the daemon",
    "runtime/can/test_moving.py": "modules on a CAN bus made as declared, followed to other numbers",
    "runtime/polled/test_shared_line.py": "modules on one RS-485 line, from the port to samples",
    "runtime/stream/test_imu61x_variants.py": "every variant of an IMU61x, from the line to actions and settings",
    "runtime/stream/test_wake.py": "a device that is silent, from the line to its state",
    "runtime/stream/test_silent.py": "every simulated variant of a module, from the line to its state",
    "signals/test_end_to_end.py": "pins of a simulated module through the whole device",
    "sim/hipnuc/uart/test_commands.py": "the simulator's replies by the chapters of the manual",
    "sim/test_main.py": "imud/sim/__main__.py as a process",
    "utc/test_gpsd_daemon.py": "a real gpsd and the daemon",
    "web/test_calibration_page.py": "the calibrations of imud/web/static in a real browser",
    "web/test_device_page.py": "the page of a device of imud/web/static in a real browser: vectors, status, settings",
    "web/test_page.py": "imud/web/static in a real browser, with the daemon and a module",
    "web/test_spectrum_page.py": "the spectrum of imud/web/static in a real browser, with a module that loses samples",
}
"""Test modules that mirror no module of imud, and what they test."""

TESTED_IN = {
    "imud.analysis.spectrum_plots": "analysis/test_noise_plots.py",
    "imud.cli.analysis.noise_page": "cli/analysis/test_commands.py",
    "imud.cli.analysis.spectrum_report": "cli/analysis/test_commands.py",
    "imud.devices.hipnuc.common.data_sheet": "devices/test_every_row.py",
    "imud.devices.imu61x.common.data_sheet": "devices/test_every_row.py",
    "imud.reload": "test_daemon_signals.py",
    "imud.publishers.shm.directory": "publishers/shm/test_hostile.py",
    "imud.cli.doctor.finding": "cli/doctor/test_report.py",
    "imud.cli.modbus.line": "cli/modbus/test_command.py",
    "imud.cli.setup.changes": "cli/setup/test_steps.py",
    "imud.cli.setup.journal": "cli/setup/test_steps.py",
    "imud.cli.setup.plan": "cli/setup/test_steps.py",
    "imud.cli.probe.report": "cli/probe/test_can.py",
    "imud.bridges.json_types": "bridges/test_json_channels.py",
    "imud.bridges.ros2_types": "bridges/test_ros2_channels.py",
    "imud.cli.foxglove.command": "cli/foxglove/test_server.py",
    "imud.cli.export.sinks": "cli/export/test_command.py",
    "imud.cli.export.mcap_sink": "cli/export/test_command.py",
    "imud.cli.export.source": "cli/export/test_command.py",
    "imud.client.watch": "client/test_connection.py",
    "imud.clock.period_learner": "clock/test_device_time.py",
    "imud.formats.fleet.commands": "publishers/mqtt/test_commands.py",
    "imud.publishers.mqtt.settings": "publishers/mqtt/test_publisher.py",
    "imud.publishers.recorder.settings": "publishers/recorder/test_continuous.py",
    "imud.config.devices": "config/test_reading.py",
    "imud.config.keys": "config/test_reading.py",
    "imud.config.model": "config/test_reading.py",
    "imud.config.schema": "config/test_reading.py",
    "imud.devices.polled_frames": "devices/test_every_polled_driver.py",
    "imud.devices.hipnuc.canopen.driver": "devices/test_every_can_driver.py",
    "imud.devices.hipnuc.canopen.moves": "devices/hipnuc/test_moves_and_settings_on_can.py",
    "imud.devices.hipnuc.canopen.settings": "devices/hipnuc/test_moves_and_settings_on_can.py",
    "imud.devices.hipnuc.j1939.moves": "devices/hipnuc/test_moves_and_settings_on_can.py",
    "imud.devices.hipnuc.j1939.settings": "devices/hipnuc/test_moves_and_settings_on_can.py",
    "imud.devices.hipnuc.j1939.actions": "devices/hipnuc/j1939/test_session.py",
    "imud.devices.hipnuc.j1939.driver": "devices/test_every_can_driver.py",
    "imud.devices.hipnuc.j1939.messages": "devices/hipnuc/j1939/test_codec.py",
    "imud.devices.hipnuc.modbus.driver": "devices/test_every_polled_driver.py",
    "imud.devices.hipnuc.modbus.registers": "devices/hipnuc/modbus/test_codec.py",
    "imud.devices.hipnuc.nmea2000.driver": "devices/test_every_can_driver.py",
    "imud.devices.hipnuc.nmea2000.messages": "devices/hipnuc/nmea2000/test_codec.py",
    "imud.devices.hipnuc.common.air": "devices/hipnuc/common/test_raw_units.py",
    "imud.devices.hipnuc.common.bus_load": "devices/hipnuc/common/test_raw_units.py",
    "imud.devices.hipnuc.uart.packets": "devices/hipnuc/uart/test_codec.py",
    "imud.devices.imu61x.spi.bursts": "devices/imu61x/spi/test_codec.py",
    "imud.devices.imu61x.spi.words": "devices/imu61x/spi/test_codec.py",
    "imud.devices.imu61x.uart.calibrations": "devices/imu61x/uart/test_calibrating.py",
    "imud.devices.hipnuc.common.main_status": "runtime/watch/test_status_watch.py",
    "imud.devices.hipnuc.uart.driver": "devices/test_every_stream_driver.py",
    "imud.devices.imu61x.can.driver": "devices/test_every_can_driver.py",
    "imud.devices.imu61x.common.registers": "devices/imu61x/spi/test_codec.py",
    "imud.devices.imu61x.i2c.driver": "devices/test_every_polled_driver.py",
    "imud.devices.imu61x.i2c.settings": "devices/imu61x/common/test_register_driver.py",
    "imud.devices.imu61x.spi.driver": "devices/test_every_polled_driver.py",
    "imud.devices.imu61x.spi.settings": "devices/imu61x/common/test_register_driver.py",
    "imud.devices.imu61x.uart.driver": "devices/test_every_stream_driver.py",
    "imud.devices.imu61x.uart.framing": "devices/imu61x/uart/test_codec.py",
    "imud.frames.settings": "config/test_frames.py",
    "imud.formats.jsonrpc": "publishers/socket/test_rpc.py",
    "imud.links.replay.file": "links/replay/test_link.py",
    "imud.links.rs485.line": "links/rs485/test_link.py",
    "imud.permissions": "links/test_device_node.py",
    "imud.publishers.metrics.family": "publishers/metrics/test_families.py",
    "imud.publishers.shm.ring": "publishers/shm/test_publisher.py",
    "imud.publishers.socket.connection": "publishers/socket/test_publisher.py",
    "imud.publishers.socket.hub": "publishers/socket/test_publisher.py",
    "imud.runtime.detection.steps": "runtime/detection/test_stream.py",
    "imud.runtime.device": "runtime/can/test_transport.py",
    "imud.runtime.device_factory": "runtime/detection/test_rounds.py",
    "imud.runtime.health": "runtime/stream/test_transport.py",
    "imud.runtime.path": "runtime/stream/test_transport.py",
    "imud.runtime.polled.path": "runtime/polled/test_transport.py",
    "imud.runtime.state_file": "runtime/detection/test_remembered.py",
    "imud.runtime.search_loop": "runtime/stream/test_transport.py",
    "imud.runtime.transport": "runtime/stream/test_transport.py",
    "imud.signals.line_actions": "runtime/test_attachments.py",
    "imud.sim.command_line": "sim/test_main.py",
    "imud.sim.control": "sim/test_main.py",
    "imud.sim.imu61x.behaviour": "sim/imu61x/test_uart.py",
    "imud.sim.imu61x.settings": "sim/imu61x/test_uart.py",
    "imud.sim.ports.in_process_bus": "links/test_spi.py",
    "imud.sim.simulator": "sim/test_sensor.py",
    "imud.utc.source": "utc/test_receivers.py",
    "imud.web.messages": "web/test_hub.py",
    "imud.worker": "runtime/polled/test_in_daemon.py",
}
"""Modules without a test module of their own, and the one that tests them with what they serve."""

PROMISES = ("imud.contracts", "imud.errors", "imud.event", "imud.units")
"""Types and constants without behaviour of their own: what uses them tests them."""


def mirrored(test: Path) -> str:
    """Name of the module that a test module is for, by its path."""
    return ".".join(("imud", *test.relative_to(TESTS).parent.parts, test.stem.removeprefix("test_")))


TEST_MODULES = [path for path in sorted(TESTS.rglob("test_*.py")) if path.relative_to(TESTS).parts[0] not in ELSEWHERE]


def test_a_test_module_stands_at_the_path_of_its_module() -> None:
    """A test module either has the path of a module of imud, or it is in CROSS_CUTTING."""
    modules = own_modules()
    names = {path: path.relative_to(TESTS).as_posix() for path in TEST_MODULES}
    wrong = [name for path, name in names.items() if (name in CROSS_CUTTING) == (mirrored(path) in modules)]
    assert not wrong, wrong


def test_a_module_has_its_tests() -> None:
    """A module either has a test module of its own, or it is in TESTED_IN."""
    mirrors = set(map(mirrored, TEST_MODULES))
    modules = [module for module in own_modules() if not module.startswith(PROMISES)]
    wrong = [module for module in modules if (module in mirrors) == (module in TESTED_IN)]
    assert not wrong, wrong


def test_the_lists_of_test_modules_are_current() -> None:
    named = {*CROSS_CUTTING, *TESTED_IN.values()}
    assert not {name for name in named if not (TESTS / name).is_file()}
    assert not TESTED_IN.keys() - own_modules().keys()
