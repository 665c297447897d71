"""`imud noise` and `imud spectrum` from the command line: captures, recordings, a running daemon."""

import json
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from imud.cli import Subcommand, main, sample_set
from imud.cli import spectrum as spectrum_live
from imud.cli.analysis import bands_hz, loaded
from imud.model.units import NS_PER_MS
from tests.cli.captures import frame, resting, shaken, write_capture
from tests.cli.conftest import Cli
from tests.cli.recorded_daemon import FRAMES, run_recorded
from tests.support.daemon_process import LIMIT_S, running_daemon, sending_daemon
from tests.support.files import CaptureWriter, hi91

SET_HZ, TRUE_HZ, SHAKEN_HZ = 400.0, 408.0, 63.7
SHEET = "source: a sheet\ngyro: {random_walk_deg_sqrt_h: 0.5}\naccel: {random_walk_m_s_sqrt_h: 0.001}\n"


@pytest.fixture(scope="module")
def shaken_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of a vibrating device at 400 Hz. Its crystal is 2 % fast, and 1 % of the samples are lost."""
    count = 16_000
    missing = np.random.default_rng(1).choice(np.arange(2000, count), count // 100, replace=False).tolist()
    accel, gyro = shaken(count, TRUE_HZ, SHAKEN_HZ)
    file = tmp_path_factory.mktemp("shaken") / "shaken.capture"
    return write_capture(file, accel, gyro, rate_hz=SET_HZ, fast=0.02, missing=missing)


@pytest.fixture(scope="module")
def resting_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of a device at rest with a rising temperature."""
    accel, gyro = resting(12_000, 100.0)
    warm = np.linspace(25.0, 32.0, len(accel))
    file = tmp_path_factory.mktemp("resting") / "a.capture"
    return write_capture(file, accel, gyro, rate_hz=100.0, temperature_c=warm)


def test_a_line_is_found_at_the_true_rate(shaken_file: Path, cli: Cli) -> None:
    accel = json.loads(cli("spectrum", "--json", "--skip", "5s", shaken_file).out)["sensors"]["accel"]
    assert (accel["rate_hz"], accel["missing"]) == (pytest.approx(TRUE_HZ, rel=1e-5), pytest.approx(160, abs=2))
    peak = accel["peaks"][0]
    assert peak["frequency_hz"] == pytest.approx(SHAKEN_HZ, abs=0.05 * accel["bin_hz"])
    assert peak["amplitude"][2] == pytest.approx(2.0, rel=0.03)
    assert peak["images_hz"] == pytest.approx([TRUE_HZ - SHAKEN_HZ, TRUE_HZ + SHAKEN_HZ], abs=0.1)


def test_a_spectrum_in_words(shaken_file: Path, tmp_path: Path, cli: Cli) -> None:
    picture = tmp_path / "vibration.png"
    words = ["spectrum", "--sensor", "accel", "--bands", "5-60,60-70", "-o", str(picture), str(shaken_file)]
    out = cli(*words, "--resolution", "0.5").out
    assert max(map(len, out.splitlines())) <= 80
    assert [words for words in ("P1", "60 to 70") if words not in out] == []
    assert "gyroscope" not in out
    for word in ("aliasing", "no manual states", "noise bandwidth", "interpolates", "Hann"):
        assert word in out, word
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_noise_of_a_capture(resting_file: Path, tmp_path: Path, cli: Cli) -> None:
    sheet = tmp_path / "sheet.yaml"
    sheet.write_text(SHEET)
    told = json.loads(cli("noise", "--json", "--sheet", sheet, resting_file).out)
    gyro, accel = told["sensors"]["gyro"], told["sensors"]["accel"]
    assert gyro["axes"]["y"]["random_walk"]["value"] == pytest.approx(1e-4, rel=0.05)
    assert gyro["axes"]["y"]["random_walk"]["deg/√h"] == pytest.approx(1e-4 * 3437.747, rel=0.05)
    assert accel["axes"]["z"]["random_walk"]["µg/√Hz"] == pytest.approx(5e-4 / 9.80665e-6, rel=0.05)
    figures = [one for sensor in (gyro, accel) for axis in sensor["axes"].values() for one in axis.values()]
    judged = [figure for figure in figures if isinstance(figure, dict)]
    assert {figure["value"] is None for figure in judged} == {True, False}
    assert all(("below" in figure) == (figure["value"] is None) for figure in judged)
    assert told["measurement"]["temperature_c"] == [25.0, 32.0]
    assert gyro["compared"][0]["ratio"] == pytest.approx(0.34377 / 0.5, rel=0.05)
    assert accel["compared"][0]["ratio"] == pytest.approx(0.03 / 0.001, rel=0.05)
    assert len(gyro["allan"]["tau_s"]) == len(gyro["allan"]["deviation"][0]) == len(gyro["allan"]["noise"][2])


@pytest.mark.parametrize("end", [".html", ".svg", ".png"])
def test_a_report_for_a_supplier(resting_file: Path, tmp_path: Path, cli: Cli, end: str) -> None:
    sheet, file = tmp_path / "sheet.yaml", tmp_path / f"report{end}"
    sheet.write_text(SHEET)
    out = cli("noise", "--sheet", sheet, "--for", "60s", "-o", file, resting_file).out
    assert max(map(len, out.splitlines())) <= 80
    for words in ("angle random walk N", "µg/√Hz", "of 0.5 deg/√h = 0.6", "times: within", "times: ABOVE", "a sheet"):
        assert words in out, words
    text = file.read_bytes()
    if end != ".png":
        assert [
            word for word in (b"angle random walk", b"Allan deviation", b"<svg", b"hipnuc-uart") if word not in text
        ] == []
        assert [word for word in (b"src=", b"<script") if word in text] == []
    if end == ".html":
        page = text.decode()
        # facts; of each sensor: units of data sheets, SI units, and a comparison, each with a head
        assert [table.count("<tr>") for table in page.split("<table>")] == [0, 10, 12, 11, 2, 13, 11, 2]
        parts = ("</table>", "<figure><svg", "<details>", "</details>", "<ul>", "<li>", "</ul>", "<p>", "class='above'")
        assert [page.count(one) for one in parts] == [7, 4, 2, 2, 2, 4, 2, 3, 1]
        for cells in ("2.84e-5", "2.843e-05", "50.5 ±0.4", "30.00</td><td class='above'>ABOVE"):
            assert f"<td class='number'>{cells}</td>" in page, cells


def test_without_a_sheet_the_report_says_what_the_manual_has(resting_file: Path, cli: Cli) -> None:
    assert "no noise figures for any model" in " ".join(cli("noise", "--for", "20s", resting_file).out.split())


# --- recordings -------------------------------------------------------------------------------------------------------


def test_a_recording_of_two_devices_and_a_part_of_it(tmp_path: Path, cli: Cli) -> None:
    (file,) = run_recorded(tmp_path)[2]
    cli.refuses("contains several devices: bow, mast; select one with --device", "noise", file)
    cli.refuses("--device stern: expected a device of the recording: bow, mast", "noise", "--device", "stern", file)
    cli.refuses("--driver applies to captures only", "noise", "--driver", "hipnuc-uart", file)
    words = ("noise", "--json", "--device", "bow", file)
    measurement = json.loads(cli(*words).out)["measurement"]
    assert measurement["samples"] == FRAMES
    assert (measurement["device"], measurement["driver"]) == ("bow", "hipnuc-uart")
    assert measurement["begun_utc_ns"] > 0
    measurement = json.loads(cli(*words, "--for", "1s").out)["measurement"]
    assert measurement["samples"] < FRAMES
    assert measurement["notes"] == [], "nothing is said of the end of the recording"


# --- captures ---------------------------------------------------------------------------------------------------------


def gappy(file: Path) -> Path:
    """Return a capture of 10 s at 100 Hz without the seventh second."""
    with file.open("wb") as out:
        writer = CaptureWriter(out, driver="hipnuc-uart", baud=115200)
        for number in [*range(600), *range(700, 1000)]:
            writer.write(hi91(10 * number), (100 + number) * 10 * NS_PER_MS)
    return file


def test_losses_are_those_of_the_part_that_was_taken(tmp_path: Path, cli: Cli) -> None:
    file = gappy(tmp_path / "c.capture")
    for part, lost in [
        ((), {"lost_gap_device": 100}), (("--for", "5s"), {}), (("--skip", "7.5s"), {}),
        (("--skip", "2s"), {"lost_gap_device": 100}),
    ]:  # fmt: skip
        assert json.loads(cli("noise", "--json", *part, file).out)["measurement"]["lost"] == lost, part


def test_a_damaged_capture_is_named_and_a_raw_one_dated_by_the_device(tmp_path: Path, cli: Cli) -> None:
    file = gappy(tmp_path / "c.capture")
    file.write_bytes(file.read_bytes() * 2)
    assert "damaged at byte" in cli("spectrum", file).out
    accel, gyro = resting(500, 100.0)
    file = tmp_path / "raw"
    file.write_bytes(b"".join(frame(10 * number, accel[number], gyro[number]) for number in range(500)))
    out = " ".join(cli("spectrum", file).out.split())
    assert [words for words in ("grid of 100.0000 Hz", "crystal is the") if words not in out] == []


# --- what is wrong ----------------------------------------------------------------------------------------------------


def test_what_cannot_be_done_is_said(tmp_path: Path, cli: Cli) -> None:
    file = write_capture(tmp_path / "short.capture", *resting(500, 100.0), rate_hz=100.0)
    for words, message in [
        (["noise", "-o", "a.pdf"], "ends in .html, .svg, .png"), (["spectrum", "-o", "a.html"], "ends in .svg or .png"),
        (["spectrum", "--resolution", "0.0001"], "resolution 0.0001 Hz: expected from"),
        (["spectrum", "--bands", "10-900"], "expected a band from 0 to 50 Hz"),
        (["noise", "--skip", "1h"], "found no samples after the first 3600 s (--skip)"),
        (["noise", "--sheet", "/nowhere"], "--sheet /nowhere"), (["noise", "-o", "/nowhere/a.svg"], "/nowhere/a.svg"),
    ]:  # fmt: skip
        cli.refuses(message, *words, file)
    device = ("noise", "bow", "--socket", str(tmp_path / "none"))
    cli.refuses("no daemon at", *device)
    cli.refuses("--baud applies to files only", *device, "--baud", "9600")


@pytest.mark.live
def test_the_extra_is_named_if_it_is_missing_and_the_daemon_does_not_load_it(resting_file: Path) -> None:
    program = (
        "import sys, imud.daemon, imud.cli\nimud.cli.build_parser()\nprint({'numpy', 'scipy'} & set(sys.modules))\n"
        f"sys.modules['scipy'] = None\nimud.cli.main(['noise', {str(resting_file)!r}])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=LIMIT_S, check=True)
    assert done.stdout == "set()\n"
    assert "imud noise: cannot import scipy; install the extra analysis: " in done.stderr


def test_bands_and_a_missing_module_of_imud(capsys: pytest.CaptureFixture[str]) -> None:
    assert bands_hz("5-50, 50-200.5") == ((5.0, 50.0), (50.0, 200.5))
    with pytest.raises(SystemExit):
        main(["spectrum", "--bands", "5,6", "file"])
    assert "expected bands in Hz" in capsys.readouterr().err
    for load in (partial(loaded, "none"), Subcommand("imud.cli.none:NONE", "", "analysis").load):
        with pytest.raises(ModuleNotFoundError, match=r"imud\.cli\.none"):
            load()


# --- a running daemon -------------------------------------------------------------------------------------------------


@pytest.mark.live
def test_spectrum_and_noise_of_a_live_device(tmp_path: Path, cli: Cli) -> None:
    accel, gyro = shaken(1000, 100.0, 12.0)
    with sending_daemon(tmp_path, lambda n: frame(10 * n, accel[n % 1000], gyro[n % 1000])) as daemon:
        live = ("--socket", daemon.socket, "bow")
        measurement = json.loads(cli("spectrum", "--json", "--for", "1.5s", *live).out)["measurement"]
        assert (measurement["device"], measurement["source"]) == ("bow", f"live from {daemon.socket}")
        assert measurement["duration_s"] == pytest.approx(1.5, abs=0.1)
        assert measurement["begun_utc_ns"] > 0
        text, error = cli("noise", "--skip", "0.2s", "--for", "1.5s", *live, status=1)
        assert max(map(len, text.splitlines())) <= 80
        assert text.splitlines()[1].startswith("  NOT AT REST: a")
        assert error.startswith("imud noise: the device was not at rest: a")
        for word in ("live from", "angle random walk N", "bow, driver hipnuc-uart"):
            assert word in text, word
        cli.refuses("stern: expected a file, or a device of the daemon (bow)", "noise", *live[:2], "stern")


@pytest.mark.live
def test_a_device_that_sends_nothing_at_all_is_named(tmp_path: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample_set, "SILENCE_S", 0.2)
    monkeypatch.setattr(spectrum_live, "SILENCE_S", 0.2)
    device = {"driver": "hipnuc-uart", "uart": {"port": str(tmp_path / "none"), "baud": 115200}}
    with running_daemon(tmp_path, {"bow": device}) as daemon:
        for on_a_terminal in (True, False):
            monkeypatch.setattr(sys.stdout, "isatty", lambda: on_a_terminal)  # noqa: B023 - it is called here
            error = cli("spectrum", "--socket", daemon.socket, "bow", status=2).err
            assert error == "imud spectrum: bow sends no samples; find the reason with `imud status`\n"
