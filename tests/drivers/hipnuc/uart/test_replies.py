"""Replies of HiPNUC devices: their end, their parts, and their values."""

import pytest

from imud.drivers.hipnuc.uart import replies as r

VERSION = ("PNAME=HI14R3", "BUILD=Oct 15 2024", "UUID=043995698D6E1708", "APP_VER=156", "BL_VER=109", "OK")


@pytest.mark.manual("B 2.2.5 VERSION", "B 2.2.5 USRCONFIG", "B 2.2.5 COMCONFIG")
def test_reports_of_the_module() -> None:
    version = r.parse_version(VERSION)
    assert (version.product, version.build, version.uuid) == ("HI14R3", "Oct 15 2024", "043995698D6E1708")
    assert (version.app_ver, version.bl_ver) == (156, 109)
    assert version.report.other == ()
    version = r.parse_version(("PNAME: CH0", "* boot ok *", "APP_VER=beta", "COLOUR=red", "PNAME=again", "OK"))
    assert (version.product, version.uuid, version.app_ver) == ("CH0", "", None)
    assert version.report.values == {"PNAME": "CH0", "APP_VER": "beta", "COLOUR": "red"}
    assert version.report.other == ("* boot ok *", "PNAME=again")

    config = r.parse_report(("ATT_MODE: 1 /* 0:6, 1:9 */", "URFR=1,0,0", "OK"))
    assert config.values == {"ATT_MODE": "1", "URFR": "1,0,0"}
    assert r.is_end("OK")
    assert not r.is_end("OKAY")
    assert r.is_rejection("ERR")
    assert r.is_rejection("ERROR: no such command")
    assert not r.is_rejection("ERR_COUNT=3")
    assert all(map(r.is_version_line, VERSION[:-1]))
    assert not any(map(r.is_setting_line, VERSION[:-1]))
    assert r.is_setting_line("ATT_MODE: 0")
    assert not r.is_version_line("ATT_MODE: 0")

    lines = ("BAUD=115200", "LOG IMU91 ONTIME 0.01", "LOG HI92 COM1 ONTIME 0", "OK")
    assert r.parse_comconfig(lines) == ({"HI91": 0.01, "HI92": 0.0}, frozenset())
    assert r.parse_report(lines) == r.Report({"BAUD": "115200"}, lines[1:3])


@pytest.mark.parametrize(
    ("text", "bias_ut"), [("14.14, -2.08, -8.75", [14.14, -2.08, -8.75]), ("1,2", None), ("1,nan,2", None), ("", None)]
)
@pytest.mark.manual("B 8.1.1 result")
def test_numbers(text: str, bias_ut: list[float] | None) -> None:
    assert r.numbers_of(text, 3) == bias_ut
