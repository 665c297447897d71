"""Live spectrum in a terminal: at most 80 columns, bars and shades at the frequency of the line."""

import os
import re
import signal
import subprocess
import tty
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from imud.analysis.spectrum import power_spectrum
from imud.cli import spectrum as command
from imud.cli.sample_set import Collector, SampleSet
from imud.cli.spectrum import CLEAR, SHADES, LiveView, SpectrumOptions, axis_line, curve_rows, in_columns
from imud.model.errors import ImudError
from imud.model.sample import Sample, Sync
from imud.model.units import NS_PER_S
from tests.cli.captures import frame, shaken
from tests.cli.conftest import imud_process
from tests.support.daemon_process import sending_daemon

RATE_HZ = 200.0
COUNT = 2000
PAGES = 4


def collected(*frequencies_hz: float, count: int = COUNT) -> Collector:
    collector = Collector("bow")
    accel = sum((shaken(count, RATE_HZ, hz)[0] for hz in frequencies_hz), np.zeros((count, 3)))
    for number, (x, y, z) in enumerate(accel.tolist()):
        t_ns = NS_PER_S + round(number * NS_PER_S / RATE_HZ)
        collector.add(Sample("bow", number + 1, t_ns, 0, Sync.EDGE, t_ns, t_ns, accel_m_s2=(x, y, z)))
    return collector


def test_the_page_also_of_too_few_samples_and_of_no_values_and_columns_bars_and_axis() -> None:
    view = LiveView("bow", "accel")
    pages = [view.page(collected(hz), SpectrumOptions(("accel",))).splitlines() for hz in (25.0, 75.0)]
    for page in pages:
        assert max(map(len, page)) <= 80
        assert page[0] == "bow accelerometer: 200.000 Hz, 0 lost, bins of 1.56 Hz"
    first, second = pages
    for page, hz in ((first, 25), (second, 75)):
        top = next(row for row in page[2:] if row.strip())
        assert len(top) - 1 == pytest.approx(80 * hz / 100, abs=2), "the highest bar"
    past = second[12:][:2]
    darkest = [max(range(len(row)), key=lambda at, row=row: SHADES.index(row[at])) for row in past]  # type: ignore[misc]
    assert darkest == [pytest.approx(60, abs=2), pytest.approx(20, abs=2)], "newest row first"
    assert any(line.startswith("  P1") and " 75.0" in line for line in second)
    assert int(second[1].split()[0]) - int(second[11].split()[0]) == 60, "range in dB"
    several = collected(*range(10, 80, 10))
    newest = [view.page(several, SpectrumOptions(("accel",))) for _ in range(9)][-1]
    assert ("; last 8 s, newest row first:" in newest, newest.splitlines()[-1][:4]) == (True, "  P5")
    assert view.page(collected(0.0), SpectrumOptions(("accel",))).endswith("\n  no line is above the noise")
    assert "at least 64 samples" in view.page(collected(25.0, count=10), SpectrumOptions(("accel",)))
    page_of_gyro = LiveView("bow", "gyro").page(collected(25.0), SpectrumOptions(("gyro",)))
    assert "sends no values of the gyroscope" in page_of_gyro
    found = SampleSet("a file", "bow", readings=collected(25.0).readings())
    assert list(command.spectrum_report(found, SpectrumOptions(("gyro", "accel"))).sensors) == ["accel"]
    with pytest.raises(ImudError, match="a file: bow sends no values of gyro"):
        command.spectrum_report(found, SpectrumOptions(("gyro",)))
    accel, _ = shaken(20_000, RATE_HZ, 30.0)
    spectrum = power_spectrum([accel], RATE_HZ, 2048)
    columns = in_columns(spectrum)
    assert (len(columns), columns.max()) == (80, spectrum.density[1:].sum(axis=1).max())
    few = in_columns(power_spectrum([accel], RATE_HZ, 64))
    assert len(few) == 80
    assert (few > 0).all()
    rows = curve_rows(np.concatenate(([1.0, 0.5, 1 / 64], np.zeros(77))))
    assert (len(rows), rows[0], rows[4], rows[-1]) == (8, "█", "██", "██▁")
    line = axis_line(200.0)
    assert len(line) == 80
    assert line.startswith("0")
    assert line.endswith("200 Hz")
    assert line.split() == ["0", "50", "100", "150", "200", "Hz"]


@pytest.mark.live
def test_it_is_redrawn_until_ctrl_c(tmp_path: Path) -> None:
    accel, gyro = shaken(1000, 100.0, 12.0)
    terminal, inside = os.openpty()
    tty.setraw(inside)  # no conversion of line ends
    text = b""
    with (
        sending_daemon(tmp_path, lambda n: frame(10 * n, accel[n % 1000], gyro[n % 1000])) as daemon,
        imud_process("spectrum", "--socket", daemon.socket, "bow", stdin=subprocess.DEVNULL, stdout=inside) as process,
    ):
        os.close(inside)
        while text.count(b"newest row first") < PAGES:  # on a slow host, the first pages have too few samples
            text += os.read(terminal, 65536)
        process.process.send_signal(signal.SIGINT)
        with suppress(OSError):  # EIO: the process closed the terminal, after a reader read all data
            while True:
                os.read(terminal, 65536)
        assert process.end().err == ""
    os.close(terminal)
    pages = [page for page in text.decode(errors="replace").split(CLEAR)[:-1] if "newest row first" in page]
    assert pages
    for page in pages:
        assert max(map(len, page.splitlines())) <= 80
        assert re.match(r"bow accelerometer: [0-9.]+ Hz, \d+ lost", page), page
        assert re.search(r"last \d+ s, newest row first", page), page
