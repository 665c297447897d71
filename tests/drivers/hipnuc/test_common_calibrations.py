"""Zero of an inclinometer on a bus, made of the actions of the driver."""

from dataclasses import dataclass

from imud.contracts.command import RestMeans, Target, Verb
from imud.drivers import DRIVERS
from imud.drivers.hipnuc.canopen.codec import HipnucCanopenOptions
from imud.drivers.hipnuc.common import inclinometer_zero
from imud.drivers.hipnuc.j1939.codec import HipnucJ1939Options
from tests.support.simulated_modules import CanopenBench


@dataclass(frozen=True)
class Began:
    name: str
    zero: str = ""


VERBS = {
    "zero": Verb("zero", lambda _target, *, zero: Began("zero", zero)),
    "save": Verb("save", lambda _target: Began("save")),
}


def test_it_is_made_of_actions() -> None:
    zero = inclinometer_zero("5.4.1", VERBS)["zero"]
    target = Target(None, 0)
    assert zero.begin(target) == Began("zero", "here")
    assert zero.save is not None
    assert zero.save(target) == Began("save")
    (expectation,) = zero.expected
    assert expectation.value(RestMeans(None, None, None, (0.001, -0.02))) == 0.02
    assert expectation.value(RestMeans(None, None, (0.0, 0.0, 0.0))) is None


def test_on_both_buses() -> None:
    bench = CanopenBench()
    zero = DRIVERS["hipnuc-canopen"].calibrations["zero"]
    bench.run_script(zero.begin(Target(HipnucCanopenOptions(node=bench.module.node), 500_000)))
    assert len(bench.sent) >= 1
    assert zero.section[0] == "5"
    zero = DRIVERS["hipnuc-j1939"].calibrations["zero"]
    request = next(zero.begin(Target(HipnucJ1939Options(), 250_000)))
    assert request.payload
    assert zero.section[0] == "6"
