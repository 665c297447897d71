"""Parts of the configuration with their keys, for references, manual pages and tests."""

import ast
import inspect
import textwrap
from collections.abc import Iterator
from typing import Final, get_args

import msgspec

from imud.attitude.published import FrameOptions, MountingAngles, MountingAxes
from imud.config.schema import TABLES, DeviceGeneral, General
from imud.contracts.condition import ConditionLimits
from imud.contracts.lines import LINE_SCHEMAS, DeviceLines
from imud.contracts.status import Deviations
from imud.fleet.settings import DeviceSending
from imud.model.options import Options
from imud.utc.receivers import RmcOptions


def docs_of(schema: type[Options]) -> dict[str, str]:
    """Return the docstring below each field of a class and of its base classes."""
    found: dict[str, str] = {}
    for base in reversed(schema.__mro__):
        if issubclass(base, Options):
            found |= _own_docs_of(base)
    return found


def _own_docs_of(schema: type[Options]) -> dict[str, str]:
    (made,) = ast.parse(textwrap.dedent(inspect.getsource(schema))).body
    assert isinstance(made, ast.ClassDef)
    found, name = {}, ""
    for node in made.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            name = node.target.id
        elif name and isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            found[name] = " ".join(str(node.value.value).split())
            name = ""
    return found


LINE_TITLES: Final = {name: text.rstrip(".") for name, text in docs_of(DeviceLines).items()}


def settings_parts() -> Iterator[tuple[str, str, type[Options]]]:
    """Yield the title, the path and the schema of each part."""
    yield "The daemon", "", General
    for name, publisher in TABLES.publishers.items():
        yield f"Output `{name}`", f"{name}.", publisher.settings
        for field in msgspec.structs.fields(publisher.settings):
            if isinstance(field.default, Options):
                yield f"Output `{name}`: `{field.name}`", f"{name}.{field.name}.", type(field.default)
    yield "Output `mqtt`: entries of `devices` (`docs/fleet.md`)", "mqtt.devices.NAME.", DeviceSending
    yield "Each device", "devices.NAME.", DeviceGeneral
    for name, link in TABLES.links.items():
        yield f"Link `{name}`", f"devices.NAME.{name}.", link.settings
    for name, driver in TABLES.drivers.items():
        yield f"Options of driver `{name}`", "devices.NAME.options.", driver.settings
        for field in msgspec.structs.fields(driver.settings):
            for part in filter(lambda one: isinstance(one, type) and issubclass(one, Options), get_args(field.type)):
                yield f"Option `{field.name}` of driver `{name}`", f"devices.NAME.options.{field.name}.", part
    for name, schema in LINE_SCHEMAS.items():
        yield f"Line `{name}`: {LINE_TITLES[name]}", f"devices.NAME.lines.{name}.", schema
    yield "Mounting of the sensor (`docs/frames.md`)", "devices.NAME.frame.", FrameOptions
    yield "Mounting by axes", "devices.NAME.frame.axes.", MountingAxes
    yield "Mounting by angles", "devices.NAME.frame.euler.", MountingAngles
    yield "Noise of a device, for covariances (`docs/export.md`)", "devices.NAME.noise.", Deviations
    yield "Limits of the condition of a device (`docs/views.md`)", "devices.NAME.condition.", ConditionLimits
    yield "RMC sentences for a device (`docs/time.md`)", "devices.NAME.rmc.", RmcOptions
