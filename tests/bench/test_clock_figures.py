"""The figures of docs/measurements.md: rows by hand, stored and read back, and plots with every row."""

from docs.generate.clock_pictures import LEAST_US, arrivals_figure, lines_figure
from tests.bench.clock_figures import ArrivalFigures, LineFigures, kept, microseconds, spread

ARRIVAL = ArrivalFigures("usb-1ms", 100, (6, 125), (88, 262), (110, 542), (90, 271), 1.0, 0.9985)
LINE = LineFigures("SOUT", "loaded", 1000, 4.3, -7.1, 44, 30, 1.0, 0.999, 0.84)


def test_rows_by_hand() -> None:
    assert ARRIVAL.row() == "| usb-1ms | 100 | 6–125 | 88–262 | 110–542 | 90–271 | 1.000 | 0.999 |"
    assert LINE.row() == "| SOUT | loaded | 1000 | 4.3 | -7.1 | 44 | 30 | 1.000 | 0.999 | 0.840 |"
    assert spread((72, 72)) == "72"
    assert [microseconds(one) for one in (0.04, 10.0, 10.4, -158.0)] == ["0.0", "10.0", "10", "-158"]


def test_both_tables_are_long() -> None:
    assert len(kept().arrivals) == 30
    assert len(kept().lines) == 44


def test_the_plot_of_arrivals_shows_every_row() -> None:
    found = kept().arrivals
    (axes,) = arrivals_figure(found).axes
    drawn = [tuple(map(float, line.get_ydata())) for line in axes.get_lines()]  # type: ignore[arg-type]
    assert drawn[::2] == [one.rms_us for one in found]
    assert drawn[1::2] == [one.mean_t_err_us for one in found]


def test_the_plot_of_lines_shows_every_row() -> None:
    found = kept().lines
    (axes,) = lines_figure(found).axes
    drawn = [float(line.get_xdata()[0]) for line in axes.get_lines()]  # type: ignore[arg-type, index]
    assert drawn[::3] == [max(one.sigma_us, LEAST_US) for one in found]
    assert drawn[1::3] == [max(abs(one.mean_us), LEAST_US) for one in found]
    assert drawn[2::3] == [one.mean_t_err_us for one in found]
    assert len(axes.get_yticklabels()) == len(found)
