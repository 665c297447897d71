"""Search for a line, and one clear error for each reason why it is not found."""

# ruff: noqa: E501 - a row of the table is a case and the whole message for it

import errno
import sys
from pathlib import Path
from types import ModuleType

import pytest

from imud.contracts.lines import LineOptions
from imud.lines.gpio import LineLocation, find_line, load_gpiod, request_error
from imud.model.errors import LinkBusy, LinkDenied, LinkError, LinkMissing
from tests.support.signal_bench import FakeGpiod


@pytest.mark.parametrize("chip", ["gpiochip0", "pinctrl-bcm2711"])
@pytest.mark.parametrize(("line", "offset", "name"), [(0, 0, "SOUT"), (1, 1, ""), ("SOUT", 0, "SOUT")])
def test_by_chip(gpiod: FakeGpiod, tmp_path: Path, chip: str, line: int | str, offset: int, name: str) -> None:
    place = find_line(gpiod, LineOptions(line=line, chip=chip), tmp_path)
    assert place == LineLocation(str(tmp_path / "gpiochip0"), offset, name)


def test_by_path_or_by_name_alone_whatever_other_names_a_chip_has(gpiod: FakeGpiod, tmp_path: Path) -> None:
    place = find_line(gpiod, LineOptions(line="TWIN", chip=str(tmp_path / "gpiochip10")))
    assert str(place) == "gpiochip10 line 1 (TWIN)"
    assert str(find_line(gpiod, LineOptions(line="RESET"), tmp_path)) == "gpiochip10 line 0 (RESET)"
    (tmp_path / "gpiochip4").symlink_to(tmp_path / "gpiochip0")
    assert find_line(gpiod, LineOptions(line="SOUT"), tmp_path).path == str(tmp_path / "gpiochip0")


@pytest.mark.parametrize(
    ("line", "chip", "kind", "message"),
    [
        ("TWIN", "", LinkError, "expected the name TWIN on one line, got it on gpiochip0 line 2 (TWIN) and gpiochip10 line 1 (TWIN)"),
        ("SOUP", "", LinkMissing, "no line has the name SOUP on gpiochip0 (pinctrl-bcm2711), gpiochip10 (expander); did you mean SOUT?"),
        ("SOUT", "expander", LinkMissing, "no line has the name SOUT on gpiochip10 (expander)"),
        (3, "gpiochip0", LinkMissing, "gpiochip0 (pinctrl-bcm2711) has no line 3: its lines are 0 to 2"),
        (0, "gpiochip7", LinkMissing, "GPIO chip gpiochip7 does not exist; existing chips: gpiochip0 (pinctrl-bcm2711), gpiochip10 (expander)"),
    ],
)  # fmt: skip
def test_errors_of_missing_lines(
    gpiod: FakeGpiod, tmp_path: Path, line: int | str, chip: str, kind: type[LinkError], message: str
) -> None:
    with pytest.raises(LinkError) as caught:
        find_line(gpiod, LineOptions(line=line, chip=chip), tmp_path)
    assert type(caught.value) is kind
    assert message in str(caught.value)


def test_no_chip_at_all_or_two_of_a_label(tmp_path: Path, gpiod: FakeGpiod) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(LinkMissing, match="on any chip: no chip exists"):
        find_line(gpiod, LineOptions(line="SOUT"), empty)
    with pytest.raises(LinkMissing, match="existing chips: none"):
        find_line(gpiod, LineOptions(line=0, chip="gpiochip0"), empty)
    gpiod.chips["gpiochip10"] = gpiod.chips["gpiochip0"]
    with pytest.raises(LinkError, match=r"on one GPIO chip, got it on gpiochip0 \(.*\) and gpiochip10 \("):
        find_line(gpiod, LineOptions(line=0, chip="pinctrl-bcm2711"), tmp_path)


def test_a_denied_chip_matters_only_if_no_other_chip_has_the_line(gpiod: FakeGpiod, tmp_path: Path) -> None:
    gpiod.errors["gpiochip0"] = errno.EACCES
    assert find_line(gpiod, LineOptions(line="RESET"), tmp_path).offset == 0
    for settings in (LineOptions(line="SOUT"), LineOptions(line=0, chip="gpiochip0"), LineOptions(line=0, chip="x")):
        with pytest.raises(
            LinkDenied, match=r"cannot open .*gpiochip0: user .* lacks the permission; the node must belong to group"
        ):
            find_line(gpiod, settings, tmp_path)


def test_a_missing_chip_matters_only_if_no_other_chip_has_the_line(gpiod: FakeGpiod, tmp_path: Path) -> None:
    gpiod.errors["gpiochip0"] = errno.ENODEV
    assert find_line(gpiod, LineOptions(line="RESET"), tmp_path).offset == 0
    with pytest.raises(LinkMissing, match="gpiochip0 is missing, or is not a GPIO chip: No such device"):
        find_line(gpiod, LineOptions(line=0, chip="gpiochip0"), tmp_path)
    (tmp_path / "ttyS0").touch()
    with pytest.raises(LinkError, match=r"cannot use .*ttyS0 as a GPIO chip"):
        find_line(gpiod, LineOptions(line=0, chip="ttyS0"), tmp_path)


@pytest.mark.parametrize(
    ("number", "kind", "message"),
    [
        (errno.EBUSY, LinkBusy, "gpiochip0 line 0 (SOUT) is in use by gpiomon: stop it"),
        (errno.EACCES, LinkDenied, "cannot open"),
        (errno.EPERM, LinkDenied, "add a line `DeviceAllow="),
        (errno.ENODEV, LinkMissing, "is missing"),
        (errno.ENXIO, LinkError, "gpiochip0 line 0 (SOUT) cannot be requested: No such device or address; an input"),
    ],
)
def test_a_line_request_that_the_kernel_refuses(
    gpiod: FakeGpiod, tmp_path: Path, number: int, kind: type[LinkError], message: str
) -> None:
    gpiod.holder = "gpiomon"
    error = request_error(gpiod, OSError(number, "by the test"), LineLocation(str(tmp_path / "gpiochip0"), 0, "SOUT"))
    assert type(error) is kind
    assert message in str(error)


def test_a_holder_without_a_name(gpiod: FakeGpiod, tmp_path: Path) -> None:
    place = LineLocation(str(tmp_path / "gpiochip0"), 0, "SOUT")
    assert "in use by an unknown program" in str(request_error(gpiod, OSError(errno.EBUSY, ""), place))
    gpiod.errors["gpiochip0"] = errno.ENODEV
    assert isinstance(request_error(gpiod, OSError(errno.EBUSY, ""), place), LinkBusy)


def test_gpiod_is_missing_or_that_of_libgpiod_1(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gpiod", None)
    with pytest.raises(LinkError, match="need the Python package gpiod, got none; run `pip install"):
        load_gpiod()
    old = ModuleType("gpiod")
    old.__file__ = "/usr/lib/python3/dist-packages/gpiod.so"
    monkeypatch.setitem(sys.modules, "gpiod", old)
    with pytest.raises(LinkError, match=r"2\.3 or later, got the module of libgpiod 1 \(/usr/lib.*Debian 12"):
        load_gpiod()


def test_gpiod_of_the_environment() -> None:
    assert hasattr(load_gpiod(), "request_lines")
