"""Metrics of the output `rules`."""

from collections.abc import Callable
from typing import Final

from imud.contracts.status import RuleStatus
from imud.publishers.metrics.metric import NO_UNIT, Family, Lines, MetricType, Reader, Snapshot


def _rule(read: Callable[[RuleStatus], float]) -> Reader:
    """Return a reader of a value of each rule and device."""

    def lines(snapshot: Snapshot) -> Lines:
        return [((one.device, one.rule), read(one)) for status in snapshot.rules for one in status.rules]

    return Reader(("device", "rule"), lines)


def _commands(snapshot: Snapshot) -> Lines:
    return [((result,), count) for status in snapshot.rules for result, count in status.commands.items()]


def _lines(snapshot: Snapshot) -> Lines:
    return [((rule,), bool(problem)) for status in snapshot.rules for rule, problem in status.lines.items()]


RULE_FAMILIES: Final = (
    Family(
        "imud_rule_active", MetricType.GAUGE, NO_UNIT, "1 if the rule is active for the device, otherwise 0.",
        _rule(lambda one: one.active),
    ),
    Family(
        "imud_rule_events_total", MetricType.COUNTER, NO_UNIT, "Number of times that the rule became active.",
        _rule(lambda one: one.begins),
    ),
    Family(
        "imud_rule_problem", MetricType.GAUGE, NO_UNIT, "1 if imud cannot evaluate the rule, otherwise 0.",
        _rule(lambda one: bool(one.problem)),
    ),
    Family(
        "imud_rule_line_problem", MetricType.GAUGE, NO_UNIT, "1 if imud cannot drive the GPIO line, otherwise 0.",
        Reader(("rule",), _lines),
    ),
    Family(
        "imud_rule_commands_total", MetricType.COUNTER, NO_UNIT, "Commands of rules by result.",
        Reader(("result",), _commands),
    ),
)  # fmt: skip
