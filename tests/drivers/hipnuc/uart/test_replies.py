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

    config = r.parse_usrconfig(("ATT_MODE: 1 /* 0:6, 1:9 */", "URFR=1,0,0", "OK"))
    assert config.att_mode == 1
    assert config.report.values == {"ATT_MODE": "1", "URFR": "1,0,0"}
    assert r.parse_usrconfig(("OK",)).att_mode is None
    assert r.is_end("OK")
    assert not r.is_end("OKAY")
    assert r.is_rejection("ERR")
    assert r.is_rejection("ERROR: no such command")
    assert not r.is_rejection("ERR_COUNT=3")
    assert all(map(r.is_version_line, VERSION[:-1]))
    assert not any(map(r.is_setting_line, VERSION[:-1]))
    assert r.is_setting_line("ATT_MODE: 0")
    assert not r.is_version_line("ATT_MODE: 0")

    port = r.parse_comconfig(("BAUD=115200", "LOG IMU91 ONTIME 0.01", "LOG HI92 COM1 ONTIME 0", "OK"))
    assert (port.periods_s, port.report.values) == ({"HI91": 0.01, "HI92": 0.0}, {"BAUD": "115200"})
    assert port.report.other == ("LOG IMU91 ONTIME 0.01", "LOG HI92 COM1 ONTIME 0")


@pytest.mark.parametrize(
    ("line", "bias_ut"),
    [("MB=14.14, -2.08, -8.75", (14.14, -2.08, -8.75)), ("MB=1,2", None), ("MB=1,nan,2", None), ("X=1", None)],
)
@pytest.mark.manual("B 8.1.1 result")
def test_magconfig(line: str, bias_ut: tuple[float, float, float] | None) -> None:
    assert r.parse_magconfig((line, "OK")).bias_ut == bias_ut
