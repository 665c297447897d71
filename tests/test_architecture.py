"""Rules for the whole tree: direction of imports, sizes, names, reads of the clock, and the place of each test module.

Each test checks all files and reports all violations together. Imports for type checking count as imports.
"""

import ast
import re
from functools import cache
from pathlib import Path
from typing import TypeGuard

PACKAGE = Path(__file__).parent.parent / "imud"

LAYERS: tuple[tuple[str, ...], ...] = (
    ("imud", "imud.model"), ("imud.host", "imud.formats", "imud.attitude"), ("imud.contracts",),
    ("imud.bridges",),
    (
        "imud.drivers", "imud.sampling", "imud.links", "imud.publishers", "imud.fleet", "imud.utc", "imud.client",
        "imud.analysis",
    ),
    ("imud.config", "imud.lines", "imud.sim", "imud.web"), ("imud.recording",), ("imud.device",), ("imud.daemon",),
    ("imud.cli", "imud.testing"), ("imud.__main__",),
)  # fmt: skip
"""Parts of imud. A part imports from lower layers and from itself; it never imports another part of its own layer."""
PARTS = tuple(name for names in LAYERS for name in names)
PURE = ("imud.drivers.", "imud.sampling.", "imud.analysis.", "imud.bridges.")
IO_MODULES = {
    "asyncio", "fcntl", "os", "pathlib", "select", "serial", "socket", "subprocess", "termios", "threading",
    "time",
}  # fmt: skip


def modules() -> dict[str, Path]:
    """Return every module of the package by name."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = ("imud", *path.relative_to(PACKAGE).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


MODULES = modules()


@cache
def tree_of(path: Path) -> ast.Module:
    """Return the syntax tree of a file."""
    return ast.parse(path.read_text())


@cache
def imports(path: Path) -> frozenset[str]:
    """Return the full names of all imports of a module, at any depth of its code."""
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


def part_of(module: str) -> str:
    """Return the part that contains a module."""
    found = [part for part in PARTS if module == part or (part != "imud" and module.startswith(part + "."))]
    assert found, f"{module} is in no layer; add its part to LAYERS"
    return found[0]


def layer_of(part: str) -> int:
    """Return the number of the layer of a part."""
    return next(number for number, names in enumerate(LAYERS) if part in names)


def own_imports(module: str) -> frozenset[str]:
    """Return the modules of imud that a module imports."""
    return imports(MODULES[module]) & MODULES.keys()


def test_a_part_imports_only_parts_of_lower_layers() -> None:
    wrong = [
        f"{module} imports {target}"
        for module in MODULES
        for target in own_imports(module)
        if (own := part_of(module)) != (other := part_of(target)) and layer_of(other) >= layer_of(own)
    ]
    assert not wrong, wrong


def test_drivers_sampling_analysis_and_bridges_do_no_io() -> None:
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


ANALYSIS = ("imud.analysis", "imud.cli.analysis", "imud.cli.noise", "imud.cli.sample_set", "imud.cli.spectrum")
HEAVY = {"numpy", "scipy", "matplotlib"}


def test_only_their_users_import_the_analysis_and_gpiod() -> None:
    wrong = [
        f"{module} imports {name}"
        for module, path in MODULES.items()
        if not module.startswith(ANALYSIS)
        for name in imports(path)
        if name.partition(".")[0] in HEAVY or name.startswith(ANALYSIS)
    ]
    assert not wrong, wrong
    assert {m for m in MODULES if "gpiod" in imports(MODULES[m])} <= {"imud.lines.gpio"}


# --- sizes ------------------------------------------------------------------------------------------------------------

LINES_MAX = 750
LINES_WITHOUT_REASON = 600
CLASS_LINES_MAX = 400
FUNCTION_LINES_MAX = 60
PARAMETERS_MAX = 6
SMALL_LINES = 130

LONG_MODULES = {
    "imud.cli.noise": "one report in three forms: text, JSON and HTML",
    "imud.cli.top": "the display of one command: table, details of a device, keys",
    "imud.device.settings": "one state machine: identity and settings of a device, with its comparison",
    "imud.drivers.hipnuc.assembly": "one assembler: samples of a device, and the losses that SIDs and periods prove",
    "imud.drivers.imu61x.uart.settings": "the table of settings with its scripts",
    "imud.links.socketcan": "one link: options, bus state, socket, and frames with their times",
    "imud.publishers.metrics.families": "one table: the metric families",
    "imud.publishers.recorder.flight": "one state machine: the flight recorder",
    "imud.publishers.shm": "one output: rings and their directory",
    "imud.sampling.clock": "one state machine with a fast path",
    "imud.sampling.device_time": "the device time and the period that it learns",
    "imud.sampling.path": "the path of the samples, for streams, CAN and polled devices",
}
LONG_CLASSES = {
    "Daemon": "one owner: start, reload, failures, ticks and stop of all parts",
    "Device": "one state machine: link, samples, commands and status of a device",
    "DeviceSettings": "one state machine: what imud knows of the settings of a device",
    "HipnucModule": "one simulated device with its commands and faults",
    "SampleClock": "one state machine with a fast path",
}
LARGE_CONSTRUCTORS = {
    "imud.cli.doctor.surroundings.Surroundings", "imud.cli.setup.steps.SetupSteps", "imud.sampling.clock.SampleClock",
    "imud.sampling.steering.Holdover", "imud.sim.can_module.PeriodicCanModule",
    "imud.sim.imu61x.registers.Imu61xRegisters",
}  # fmt: skip
"""Constructors with more parameters, from before this rule. Add none."""


def test_modules_classes_functions_and_constructors_have_a_limit() -> None:
    wrong = []
    for module, path in MODULES.items():
        lines = len(path.read_text().splitlines())
        if lines > LINES_MAX or (lines > LINES_WITHOUT_REASON) != (module in LONG_MODULES):
            wrong.append(f"{module}: {lines} lines")
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ClassDef):
                wrong += [f"{module}.{words}" for words in limits_exceeded(module, node)]
            elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and length(node) > FUNCTION_LINES_MAX:
                wrong.append(f"{module}.{node.name}: {length(node)} lines")
    assert not wrong, wrong


def length(node: ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    return (node.end_lineno or node.lineno) - node.lineno + 1


def limits_exceeded(module: str, node: ast.ClassDef) -> list[str]:
    """Return the limits that a class exceeds, and its unnecessary exceptions."""
    found = []
    if (length(node) > CLASS_LINES_MAX) != (node.name in LONG_CLASSES):
        found.append(f"{node.name}: {length(node)} lines")
    for one in node.body:
        if isinstance(one, ast.FunctionDef) and one.name == "__init__":
            parameters = len([*one.args.posonlyargs, *one.args.args, *one.args.kwonlyargs]) - 1
            if (parameters > PARAMETERS_MAX) != (f"{module}.{node.name}" in LARGE_CONSTRUCTORS):
                found.append(f"{node.name}: {parameters} parameters")
    return found


@cache
def classes() -> dict[str, ast.ClassDef]:
    """Return all classes of the package by name. A name is public once (see below)."""
    trees = [tree_of(path) for path in MODULES.values()]
    return {node.name: node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef)}


def bases_of(node: ast.ClassDef) -> list[ast.ClassDef]:
    """Return a class and its base classes in this package."""
    found = [node]
    for base in node.bases:
        named = classes().get(ast.unparse(base).partition("[")[0])
        found += bases_of(named) if named is not None and named is not node else []
    return found


def is_protocol(node: ast.ClassDef) -> bool:
    return any(ast.unparse(base).startswith("Protocol") for base in node.bases)


FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


def members(node: ast.ClassDef) -> set[str]:
    """Return the public methods, fields and attributes of a class and its bases."""
    found = set()
    for owner in bases_of(node):
        found |= {
            one.attr for one in ast.walk(owner) if isinstance(one, ast.Attribute) and isinstance(one.ctx, ast.Store)
        }
        found |= {one.name for one in owner.body if isinstance(one, FUNCTIONS)}
        fields = [one for one in owner.body if isinstance(one, ast.Assign | ast.AnnAssign)]
        found |= {ast.unparse(target) for one in fields for target in getattr(one, "targets", ())}
        found |= {ast.unparse(one.target) for one in fields if isinstance(one, ast.AnnAssign)}
    return {name for name in found if not name.startswith("_")}


def own_functions_passed(owner: ast.ClassDef) -> list[str]:
    """Return the calls of constructors with a method of `owner`, or with a function that uses `self`."""
    names = {one.name for base in bases_of(owner) for one in base.body if isinstance(one, FUNCTIONS)}
    properties = {
        one.name
        for base in bases_of(owner)
        for one in base.body
        if isinstance(one, FUNCTIONS) and "property" in " ".join(map(ast.unparse, one.decorator_list))
    }
    local = {
        one.name for one in ast.walk(owner) if isinstance(one, FUNCTIONS) and one not in owner.body and uses_self(one)
    }
    return [
        f"{owner.name}: {ast.unparse(call.func)}({ast.unparse(argument)})"
        for call in ast.walk(owner)
        if isinstance(call, ast.Call) and ast.unparse(call.func).rpartition(".")[2] in classes().keys() - RECORDS
        for argument in (*call.args, *(keyword.value for keyword in call.keywords))
        if (isinstance(argument, ast.Lambda) and uses_self(argument))
        or (isinstance(argument, ast.Name) and argument.id in local)
        or ast.unparse(argument) in {f"self.{name}" for name in names - properties}
    ]


def uses_self(node: ast.AST) -> bool:
    return any(isinstance(one, ast.Name) and one.id == "self" for one in ast.walk(node))


RECORDS = {"LineFactory", "PublisherContext", "Reader", "Request"}
"""Records of functions, without behavior."""


def test_a_constructor_receives_no_function_of_the_object_that_calls_it() -> None:
    nodes = [node for path in MODULES.values() for node in ast.walk(tree_of(path)) if isinstance(node, ast.ClassDef)]
    wrong = [call for node in nodes for call in own_functions_passed(node)]
    assert not wrong, wrong


FOR_TESTS = {
    "BrokerConnection": "tests connect without a broker", "Viewer": "tests record the messages",
    "WatchingWorker": "tests do the rounds of a bus in the event loop", "Worker": "tests do the rounds themselves",
}  # fmt: skip
"""Protocols with one implementation in `imud/` and another implementation in `tests/`."""
OTHER_LIBRARIES = {"I2cBus": "smbus2", "Poller": "select.epoll", "_Event": "PyYAML"}
"""Protocols that describe an object of another library."""


def test_a_protocol_has_two_implementations_or_a_reason() -> None:
    """One implementation is enough if the docstring names its part, which the users may not import."""
    wrong = []
    parts = {node.name: part_of(m) for m, path in MODULES.items() for node in tree_of(path).body if is_class(node)}
    found = {name: members(node) for name, node in classes().items() if not is_protocol(node)}
    for name, node in classes().items():
        wanted = members(node)
        if not is_protocol(node) or not wanted or name in FOR_TESTS or name in OTHER_LIBRARIES:
            continue  # a protocol without a public member is the type of a function (`__call__`)
        made_by = [one for one, has in found.items() if wanted <= has]
        words = ast.get_docstring(node) or ""
        is_named = any(f"`{parts.get(one)}`" in words and "import" in words for one in made_by)
        if len(made_by) < 2 and not is_named:
            wrong.append(f"{name}: {made_by}")
    assert not wrong, wrong
    assert not (FOR_TESTS.keys() | OTHER_LIBRARIES.keys()) - classes().keys()


def is_class(node: ast.stmt) -> TypeGuard[ast.ClassDef]:
    return isinstance(node, ast.ClassDef)


def test_a_small_module_has_several_importers() -> None:
    """A module below SMALL_LINES that one module of its folder imports is a part of that module."""
    importers: dict[str, set[str]] = {}
    for module in MODULES:
        for target in own_imports(module):
            importers.setdefault(target, set()).add(module)
    wrong = []
    for module, path in own_modules().items():
        users = importers.get(module, set())
        is_near = {user.rpartition(".")[0] for user in users} == {module.rpartition(".")[0]}
        if len(users) == 1 and is_near and len(path.read_text().splitlines()) < SMALL_LINES:
            wrong.append(f"{module}, imported by {users}")
    assert not wrong, wrong


def test_a_folder_has_three_modules() -> None:
    counts: dict[str, int] = {}
    for module, path in MODULES.items():
        folder = module if path.name == "__init__.py" else module.rpartition(".")[0]
        while folder != "imud":
            counts[folder] = counts.get(folder, 0) + (path.name != "__init__.py")
            folder = folder.rpartition(".")[0]
    wrong = {folder: count for folder, count in counts.items() if count < 3}
    assert not wrong, wrong


VERB_FORM = re.compile(r"[a-z_]+ing")
NOUNS = {"edge_pairing", "readdressing", "reading", "recording", "ring", "setting", "steering", "thinning"}
SURROUNDINGS = {"ways", "moves", "contact", "attached", "questions", "helpers", "utils", "misc", "common_code"}


def test_the_name_of_a_module_is_a_noun() -> None:
    wrong = [
        module
        for module in own_modules()
        if ((name := module.rpartition(".")[2]) in SURROUNDINGS or VERB_FORM.fullmatch(name)) and name not in NOUNS
    ]
    assert not wrong, wrong


# --- names -----------------------------------------------------------------------------------------------------------


@cache
def own_modules() -> dict[str, Path]:
    """Return the modules with code of their own: no `__init__` of a package, and no entry point of a program."""
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
    "imud.host.clock",
    "imud.host.event_loop",  # the remaining time of a wait, by the clock of asyncio's timers
    "imud.cli",  # a process of its own, like the client, the fleet reader and the simulator
    "imud.client", "imud.fleet.reader", "imud.fleet.database.store", "imud.sim.__main__",
    "imud.links",  # in the callback that reads, and in waits for the end of a transfer
    "imud.web.foxglove",  # the server of `imud foxglove`, a process of its own
)  # fmt: skip


def clock_uses(path: Path) -> list[str]:
    """Return every place that reads a clock, or uses a clock function as a default."""
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
    """Return whether the module, or a package that contains it, may read clocks."""
    return any(module == name or module.startswith(name + ".") for name in MAY_READ_CLOCKS)


def test_time_is_an_argument() -> None:
    wrong = {m: uses for m, path in MODULES.items() if not may_read_clocks(m) and (uses := clock_uses(path))}
    assert not wrong, wrong


# --- tests ------------------------------------------------------------------------------------------------------------


def private_writes(path: Path) -> list[str]:
    """Return every place where a test sets an underscore member of another object, or patches such a member by name."""
    if not re.search(r"[.\"']_[a-z]", path.read_text()):
        return []  # most files: this avoids seconds of parsing
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


# --- names from outside -------------------------------------------------------------------------------------------

IMPORTERS = {
    "imud.cli": "the table of commands",
    "imud.cli.analysis": "names of modules in the code",
    "imud.config.parts": "a constant",
    "imud.contracts.registry": "the fixed rows of a registry",
    "imud.fleet.broker": "a constant",
    "imud.formats.kernel": "a constant",
    "imud.sampling.attitude": "a constant",
    "imud.sampling.path": "a constant",
}
"""Modules that import by a name at run time, and the source of the name. A file, a peer or a configuration is never the
source."""
EXECUTORS = {"eval", "exec", "compile", "__import__"}
OBJECT_FORMATS = {"pickle", "marshal", "shelve", "dill", "jsonpickle", "multiprocessing"}
SETTERS = {
    "imud.drivers.foreign": "LEDGER_FIELDS",
    "imud.fleet.paho_client": "names of callbacks and properties in the code",
    "imud.fleet.database.transaction": "fields of a struct",
    "imud.formats.state": "fields of a table",
    "imud.links.serial_port": "names in the code",
    "imud.model.ledger": "LEDGER_FIELDS",
    "imud.publishers.rules.limit": "__slots__",
    "imud.recording.calls": "LEDGER_FIELDS",
    "imud.recording.player": "FROM_OUTSIDE",
}
"""Modules that set an attribute by name, and the source of the name."""


def test_data_select_no_module_and_no_code() -> None:
    """Foreign data create values only. Before you add a module, check that no name comes from outside."""
    importers, setters, wrong = set(), set(), []
    for module, path in MODULES.items():
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.Name | ast.Attribute) and ast.unparse(node).rpartition(".")[2] == "import_module":
                importers.add(module)
            elif isinstance(node, ast.Call):
                name = ast.unparse(node.func).rpartition(".")[2]
                is_built_in = isinstance(node.func, ast.Name)
                if name in ("setattr", "__setattr__"):
                    setters.add(module)
                elif is_built_in and name in EXECUTORS:
                    wrong.append(f"{module}: {name}")
            elif isinstance(node, ast.Import | ast.ImportFrom):
                names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [one.name for one in node.names]
                wrong += [f"{module}: {name}" for name in names if name.partition(".")[0] in OBJECT_FORMATS]
    assert not wrong, wrong
    assert importers == IMPORTERS.keys()
    assert setters == SETTERS.keys()


# --- a test by the path of its module ---------------------------------------------------------------------------------

ELSEWHERE = (
    "audit", "bench", "lab", "lab_debian", "include", "fuzz", "attack", "support", "packaging", "monitoring",
    "stability",
)  # fmt: skip
"""Folders of tests that do not belong to one package: measurements, kernels, the C header, fuzzing, helpers, packages,
monitoring, and stored interfaces."""

CROSS_CUTTING = {
    "cli/test_main.py": "`main` of imud/cli/__init__.py",
    "contracts/test_facts.py": "words, counts and defaults in codec, driver, lines, setting and status",
    "drivers/hipnuc/canopen/test_peers.py": "the canopen library as a peer of codec and simulator",
    "drivers/hipnuc/test_firmware_update.py": "firmware updates of the drivers with simulated boot loaders",
    "drivers/hipnuc/test_firmware_vendor_tool.py": "the vendor's host tools as peers of the simulated boot loaders",
    "drivers/hipnuc/test_moves_and_settings_on_can.py": "settings and new addresses of the drivers on CAN",
    "drivers/imu61x/test_one_truth.py": "one motion through every protocol of the family",
    "drivers/test_every_can_driver.py": "every driver on CAN",
    "drivers/test_every_device_settings.py": "the settings of every driver",
    "drivers/test_every_polled_driver.py": "every polled driver",
    "drivers/test_every_row.py": "the rows, calibrations, data sheets, options and counters of every driver",
    "drivers/test_every_stream_driver.py": "every driver of byte streams",
    "lines/test_end_to_end.py": "pins of a simulated device through the whole device",
    "links/test_failed_steps.py": "every step after the opening of a CAN link",
    "links/test_kernel_constants.py": "numbers of the kernel in all links",
    "publishers/recorder/test_kills.py": "daemons that record and are killed",
    "publishers/socket/test_command.py": "`command` through connection, rights and RPC",
    "publishers/socket/test_documentation.py": "docs/protocol.md",
    "publishers/socket/test_latency.py": "latency requests of clients, through RPC and hub",
    "sim/test_main.py": "imud/sim/__main__.py as a process",
    "test_architecture.py": "the tree itself",
    "test_docs.py": "README.md, docs, Makefile",
    "test_docs_site.py": "the site of `make docs-site`, also in a real browser",
    "test_end_to_end.py": "the daemon as a process, with its clients",
    "test_report.py": "docs/generate/report.py and docs/measurements",
    "test_example_package.py": "docs/drivers.md and packages with drivers, outputs and simulators",
    "web/test_calibration_page.py": "the calibrations of imud/web/static in a real browser",
    "web/test_device_page.py": "the page of a device of imud/web/static in a real browser: vectors, status, settings",
    "web/test_page.py": "imud/web/static in a real browser, with the daemon and a device",
    "web/test_spectrum_page.py": "the spectrum of imud/web/static in a real browser, with a device that loses samples",
}
"""Test modules without a single module, and their subjects."""

TESTED_IN = {
    "imud.device.timetable": "device/test_polled_bus.py",
    "imud.publishers.nmea2000.port": "publishers/nmea2000/test_output.py",
    "imud.cli.schema": "cli/test_main.py", "imud.cli.setup.changes": "cli/setup/test_steps.py",
    "imud.cli.sim": "sim/test_main.py", "imud.sampling.driver_clock": "sampling/test_path.py",
    "imud.config.model": "config/test_reading.py", "imud.publishers.rules.settings": "publishers/rules/test_limit.py",
    "imud.device.recordable": "device/test_can_transport.py",
    "imud.config.parts": "config/test_reading_signals.py",
    "imud.config.schema": "config/test_reading.py", "imud.device.device": "device/test_can_transport.py",
    "imud.device.factory": "device/test_search.py", "imud.device.transport": "device/test_stream_transport.py",
    "imud.device.pending_updates": "device/test_firmware_faults.py", "imud.device.turns": "device/test_calibration.py",
    "imud.drivers.hipnuc.bus_load": "drivers/hipnuc/test_common.py",
    "imud.drivers.hipnuc.canopen.cia301": "drivers/hipnuc/canopen/test_commands.py",
    "imud.drivers.hipnuc.canopen.firmware": "drivers/hipnuc/test_firmware_update.py",
    "imud.drivers.hipnuc.uart.kboot": "drivers/hipnuc/test_firmware_update.py",
    "imud.sim.hipnuc.boot_loader": "drivers/hipnuc/test_firmware_update.py",
    "imud.drivers.hipnuc.canopen.driver": "drivers/hipnuc/canopen/test_commands.py",
    "imud.drivers.hipnuc.j1939.driver": "drivers/test_every_can_driver.py",
    "imud.drivers.hipnuc.modbus.driver": "drivers/hipnuc/modbus/test_commands.py",
    "imud.drivers.hipnuc.modbus.registers": "drivers/hipnuc/modbus/test_commands.py",
    "imud.drivers.hipnuc.uart.driver": "drivers/hipnuc/uart/test_commands.py",
    "imud.drivers.hipnuc.uart.replies": "drivers/hipnuc/uart/test_commands.py",
    "imud.drivers.imu61x.common": "drivers/imu61x/test_i2c.py",
    "imud.drivers.imu61x.registers": "drivers/imu61x/test_i2c.py",
    "imud.drivers.imu61x.uart.driver": "drivers/imu61x/uart/test_commands.py",
    "imud.drivers.polled_frames": "drivers/test_every_polled_driver.py",
    "imud.drivers.state": "sampling/test_state.py", "imud.drivers.hipnuc.assembly_state": "sampling/test_state.py",
    "imud.sampling.fit_state": "sampling/test_state.py", "imud.sampling.aiding_state": "sampling/test_state.py",
    "imud.fleet.settings": "fleet/test_publisher.py", "imud.fleet.database.tables": "fleet/database/test_rows.py",
    "imud.links.cyclic_sender": "links/test_socketcan.py", "imud.host.netlink": "links/test_socketcan.py",
    "imud.model.bucket": "publishers/socket/test_history.py",
    "imud.publishers.ros2.options": "publishers/ros2/test_output.py",
    "imud.publishers.metrics.metric": "publishers/metrics/test_families.py",
    "imud.sim.hipnuc.ins": "sim/hipnuc/test_uart.py",
    "imud.sim.control": "sim/test_sensor.py", "imud.sim.hipnuc.nmea2000": "sim/test_can_module.py",
    "imud.sim.imu61x.can": "sim/test_can_module.py", "imud.sim.ports.arrival": "sim/ports/test_faults.py",
    "imud.sim.ports.in_process_bus": "links/test_spi.py", "imud.sim.ports.uart_wire": "sim/ports/test_pty.py",
    "imud.testing.can": "drivers/test_every_can_driver.py", "imud.testing.invariants": "testing/test_stream.py",
    "imud.testing.polled": "drivers/test_every_polled_driver.py", "imud.testing.rows": "testing/test_stream.py",
    "imud.web.messages": "web/test_hub.py",
}  # fmt: skip
"""Modules without a test module of their own, and the test module that covers them."""

TYPES_ONLY = ("imud.contracts", "imud.model.errors", "imud.model.event", "imud.model.units")
"""Types and constants without behavior. The tests of their users cover them."""

TEST_MODULES = [path for path in sorted(TESTS.rglob("test_*.py")) if path.relative_to(TESTS).parts[0] not in ELSEWHERE]


def module_of(test: Path) -> str | None:
    """Return the module that `test_MODULE.py` or `test_MODULE_TOPIC.py` tests; None if no module has this name."""
    folder = ".".join(("imud", *test.relative_to(TESTS).parent.parts))
    words = test.stem.removeprefix("test_").split("_")
    names = [f"{folder}.{'_'.join(words[:count])}" for count in range(len(words), 0, -1)]
    return next((name for name in names if name in own_modules()), None)


def test_the_name_of_a_test_module_begins_with_its_module() -> None:
    names = {path: path.relative_to(TESTS).as_posix() for path in TEST_MODULES}
    wrong = [name for path, name in names.items() if (name in CROSS_CUTTING) == (module_of(path) is not None)]
    assert not wrong, wrong


def test_a_module_has_its_tests() -> None:
    """A module either has test modules of its own, or it is in TESTED_IN."""
    tested = set(map(module_of, TEST_MODULES))
    modules = [module for module in own_modules() if not module.startswith(TYPES_ONLY)]
    wrong = [module for module in modules if (module in tested) == (module in TESTED_IN)]
    assert not wrong, wrong


def test_the_lists_of_test_modules_are_current() -> None:
    named = {*CROSS_CUTTING, *TESTED_IN.values()}
    assert not {name for name in named if not (TESTS / name).is_file()}
    assert not TESTED_IN.keys() - own_modules().keys()
