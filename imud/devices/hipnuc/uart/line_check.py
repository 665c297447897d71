"""Comparison of the GPIO lines in the configuration with the module's own settings of its pins and messages.

A line that is wired and configured does nothing where the module has its function elsewhere, or not at all: manual
"IMU配置手冊" V1.5.9, sections 1.2 and 2.2.4. What the module does not tell is not compared.
"""

from collections.abc import Iterator, Mapping
from typing import Any, Final, get_args

from imud.contracts.lines import DeviceLines
from imud.devices.hipnuc.uart.commands import BAUD_RATES, MAX_RATE_HZ, OutputMessage
from imud.devices.hipnuc.uart.settings import ON_MARK, MessageName, values_of

FUNCTIONS: Final = {"sin": "sin", "pps": "sin", "sout": "sout", "sout_div": "sout_div", "alarm": "alarm"}
"""Function of the module's pin by the key of the line."""


def line_differences(settings: Mapping[str, str], lines: DeviceLines) -> dict[str, str]:
    """Return what the module's settings contradict, one sentence by the line's key, from `session.read_settings`."""
    return _differences(values_of(settings), lines)


def declared_line_differences(values: Mapping[str, Any], lines: DeviceLines) -> dict[str, str]:
    """Return what declared settings contradict. What is declared in part is not compared: the module has the rest."""
    known = dict(values)
    if set(known.get("output") or ()) != set(get_args(MessageName)):
        known.pop("output", None)
    known.pop("alarm", None)
    return _differences(known, lines)


def message_limits(values: Mapping[str, Any], lines: DeviceLines, fed: bool) -> list[str]:
    """Return what HI92 cannot do of all that the configuration has, if declared settings have the module send it.

    `fed`: sentences with UTC are sent to the module.
    """
    output = values.get("output") or {}
    if not output.get("hi92"):
        return []
    found = []
    if fed or lines.pps is not None:
        found.append("HI92 never shows UTC: its samples are dated by the host; those of HI91 can be on UTC")
    if output.get("hi91"):
        found.append("HI92 beside HI91 is dated by its arrival; alone it is dated by its stamp")
    return found


def _differences(values: Mapping[str, Any], lines: DeviceLines) -> dict[str, str]:
    found: dict[str, list[str]] = {}
    for key, words in (
        *_shared_pins(values.get("pins", {}), lines),
        *_divisor(values.get("sout_divisor"), lines),
        *_marks(values.get("output"), values.get("baud"), lines),
        *_alarm_differences(values.get("alarm"), lines),
    ):
        found.setdefault(key, []).append(words)
    return {key: "; ".join(words) for key, words in found.items()}


def _shared_pins(pins: Mapping[str, int], lines: DeviceLines) -> Iterator[tuple[str, str]]:
    """Two functions on one pin: which of them the module serves is not known."""
    for key, function in FUNCTIONS.items():
        if getattr(lines, key) is None or function not in pins:
            continue
        others = [other for other, pin in pins.items() if pin == pins[function] and other != function]
        if others:
            yield key, f"the module has {function} and {' and '.join(others)} on IO{pins[function]}: set one with pin"


def _divisor(divisor: int | None, lines: DeviceLines) -> Iterator[tuple[str, str]]:
    configured = lines.sout_div.divisor if lines.sout_div is not None else divisor
    if divisor is not None and configured != divisor:
        yield "sout_div", f"divisor is {configured} in the configuration, and the module divides SOUT by {divisor}"


def _marks(output: Mapping[str, Any] | None, baud: int | None, lines: DeviceLines) -> Iterator[tuple[str, str]]:
    """Triggers need a message on mark that the line carries at their rate; a pulse per second needs none."""
    if output is None:
        return
    marked = [OutputMessage(name.upper()) for name, rate in output.items() if rate == ON_MARK]
    if lines.sin is not None:
        if not marked:
            yield "sin", "no message of the module is on mark, so that triggers make no samples: output_on_mark sets it"
        for message in marked:
            most_hz = MAX_RATE_HZ[message].get(baud or 0)
            if baud in BAUD_RATES and most_hz is not None and lines.sin.rate_hz > most_hz:
                yield "sin", f"{lines.sin.rate_hz:g} triggers a second, and {baud} baud carry {most_hz} Hz of {message}"
        if marked == [OutputMessage.HI92]:
            yield "sin", "HI92 on mark has no time of its own: samples are not paired with triggers, HI91 is"
    if lines.pps is not None and marked:
        yield "pps", f"{' and '.join(marked)} on mark: each pulse per second makes a sample; output sets a rate"


def _alarm_differences(alarm: Mapping[str, Any] | None, lines: DeviceLines) -> Iterator[tuple[str, str]]:
    if alarm is not None and lines.alarm is not None and not any(one.enabled for one in alarm.values()):
        yield "alarm", "the module watches no angle, so that the line stays low: alarm sets a range"
