"""Plots of sweeps: artists show the values of the table, and no table makes a plot fail."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from small import table_of

from srs_twin.comparison.metrics import (
    COMPARISON_UNITS,
    LIST_METRIC_UNITS,
    METRIC_UNITS,
)
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.studies.sweep.plots import draw as draw_results
from srs_twin.studies.sweep.points import Plot
from srs_twin.viewing.plots.labels import field_label, metric_label
from srs_twin.viewing.plots.style import save

F = "controller.frequency_hz"
P = "supply.pressure_kpa"
OFFSET = "controller.offset"
SPEED = "com_speed_m_s"
A = "analytical.com_speed_m_s"
B = "twin.com_speed_m_s"


def draw(plot, columns):
    """Return the figure of a plot of columns."""
    return draw_results(plot, table_of(columns))


def plot(kind, x, metric, by=None):
    return Plot(kind=kind, x=x, metric=metric, by=by)


LINE = plot("line", F, SPEED)


def speed_at(f, p):
    return 0.1 + 0.02 * f + 0.003 * p


def table(f, p, *, failed=(), missing=(), fraction=0.8):
    rows = len(f)
    lost = np.isin(np.arange(rows), [*failed, *missing])
    ours = [
        None if gone else float(v) for gone, v in zip(lost, speed_at(f, p), strict=True)
    ]
    return {
        "key": [f"{i:064x}" for i in range(rows)],
        F: list(map(float, f)),
        P: list(map(float, p)),
        "status": ["failed" if i in failed else "done" for i in range(rows)],
        "reason": ["diverged" if i in failed else None for i in range(rows)],
        A: ours,
        B: [None if v is None else fraction * v for v in ours],
        "comparison.com_speed_rel": [None if v is None else fraction - 1 for v in ours],
        "wall_s": [0.1] * rows,
    }


def grid(frequencies=(0.5, 1.0, 1.5, 2.0), pressures=(20.0, 30.0, 40.0), **lost):
    f, p = (item.ravel() for item in np.meshgrid(frequencies, pressures))
    return table(f, p, **lost)


def planes(figure: Figure):
    """Return the axes without those of colour bars."""
    return [axes for axes in figure.axes if axes.get_label() != "colors"]


def curves(axes):
    return [line for line in axes.lines if line.get_label().startswith("_")]


def marks(axes, what):
    (line,) = [line for line in axes.lines if line.get_label() == what]
    return set(map(tuple, np.asarray(line.get_xydata()).round(9).tolist()))


def dots(axes):
    (result,) = [item for item in axes.collections if isinstance(item, PathCollection)]
    return result


def words(figure):
    texts = [
        figure.get_suptitle(),
        *(text.get_text() for axes in figure.axes for text in axes.texts),
    ]
    return "\n".join(texts)


def twice(field, values=(0.0, 0.4)):
    """Return the grid at two values of a further field; the speed is three times as high at the second."""
    low = grid()
    both = {name: [*column, *column] for name, column in low.items()}
    both[field] = [values[0]] * 12 + [values[1]] * 12
    both[A] = [*low[A], *(3 * v for v in low[A])]
    del both[B]
    return both


def test_seeds_are_averaged_with_a_note():
    figure = draw(plot("line", F, SPEED, by=P), twice("seed", (0, 1)))
    (axes,) = planes(figure)
    assert "each value the mean over random seed" in words(figure)
    highest = max(line.get_ydata().max() for line in curves(axes))
    assert highest == pytest.approx(2 * max(grid()[A]))
    assert "mean over" not in words(
        draw(plot("scatter", F, SPEED), twice("seed", (0, 1)))
    )


def test_failed_and_missing_runs_are_counted():
    figure = draw(LINE, grid(failed=(0, 11), missing=(3,)))
    assert "2 of 12 runs failed" in words(figure)
    assert "2 values missing" in words(figure)


def test_lines_do_not_average_over_varied_fields():
    """The first remaining field determines the colour of a line; `by` gives one line per value."""
    both = twice(OFFSET) | {
        P: [30.0] * 24,
        F: [1.0, 2.0, 3.0] * 8,
        "plants.twin.gaps": [True, False] * 12,
    }
    (axes,) = planes(draw(LINE, both | {"plants.twin.gaps": [True] * 24}))
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["0", "0.4"]
    assert len(curves(axes)) == 2
    figure = draw(plot("line", F, SPEED, by=OFFSET), both)
    assert (
        len(curves(planes(figure)[0])) == 4
        and "one line for each whether the segments have rigid gaps"
        in words(figure).lower()
    )
    # Every sample has different values: nothing is at the same place, and nothing is
    # averaged.
    sampled = grid() | {
        F: np.linspace(1, 2, 12).tolist(),
        OFFSET: np.linspace(0, 1, 12).tolist(),
    }
    figure = draw(LINE, sampled)
    assert len(curves(planes(figure)[0])) == 2 and "one line" not in words(figure)


def test_lines_show_the_table_by_value_and_plant():
    values = grid(failed=(5,))
    figure = draw(plot("line", F, SPEED, by=P), values)
    (axes,) = planes(figure)
    drawn = curves(axes)
    assert len(drawn) == 2 * 3
    for k, line in enumerate(drawn):
        pressure = (20.0, 30.0, 40.0)[k % 3]
        fraction = (1.0, 0.8)[k // 3]
        x, y = line.get_data()
        assert np.array_equal(x, [0.5, 1.0, 1.5, 2.0])
        expected = fraction * speed_at(x, pressure)
        expected[(x == 1.0) & (pressure == 30.0)] = np.nan
        assert y == pytest.approx(expected, nan_ok=True)
    assert len({line.get_color() for line in drawn[:3]}) == 3
    assert [line.get_color() for line in drawn[:3]] == [
        line.get_color() for line in drawn[3:]
    ]
    assert len({line.get_linestyle() for line in drawn}) == 2
    assert marks(axes, "failed") == {(1.0, 0.025)}
    legend = axes.get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["20", "30", "40"]
    assert legend.get_title().get_text().replace("\n", " ") == "supply pressure (kPa)"


def test_many_lines_have_a_colour_bar():
    figure = draw(plot("line", F, SPEED, by=P), grid(pressures=np.linspace(20, 40, 13)))
    (bar,) = [axes for axes in figure.axes if axes.get_label() == "colors"]
    assert (
        bar.get_ylabel() == "supply pressure (kPa)"
        and len(curves(planes(figure)[0])) == 26
    )


@pytest.mark.parametrize("count", [3, 13])
def test_scatter_plots_show_the_table(count):
    """Few colours are explained by a legend, many by a colour bar."""
    given = grid(pressures=np.linspace(20, 40, count), missing=(2,))
    del given[A]
    figure = draw(plot("scatter", "com_speed_rel", SPEED, by=P), given)
    (axes,) = planes(figure)
    expected = [
        (x, y, c)
        for x, y, c in zip(
            given["comparison.com_speed_rel"], given[B], given[P], strict=True
        )
        if y
    ]
    if count == 3:
        key = axes.get_legend()
        shades = {
            to_hex(line.get_color()): float(text.get_text())
            for line, text in zip(key.get_lines(), key.get_texts(), strict=True)
        }
        values = [shades[to_hex(color)] for color in dots(axes).get_facecolors()]
    else:
        values = dots(axes).get_array()
    result = [(*at, c) for at, c in zip(dots(axes).get_offsets(), values, strict=True)]
    assert np.array(sorted(result)) == pytest.approx(np.array(sorted(expected)))
    assert (
        axes.get_xlabel() == "CoM speed, relative difference"
        and axes.get_ylabel() == "CoM speed (m/s)"
    )


def test_text_and_boolean_values_are_categories():
    values = grid(frequencies=(1.0, 2.0), pressures=(30.0,))
    values["plants.analytical.model"] = ["simplified", "complete"]
    values["plants.twin.gaps"] = [True, False]
    (axes,) = planes(draw(plot("line", "plants.analytical.model", SPEED), values))
    assert [tick.get_text() for tick in axes.get_xticklabels()] == [
        "complete",
        "simplified",
    ]
    x, y = curves(axes)[0].get_data()
    assert np.array_equal(x, [0, 1]) and y == pytest.approx(
        [speed_at(2.0, 30.0), speed_at(1.0, 30.0)]
    )
    (axes,) = planes(draw(plot("line", "plants.twin.gaps", SPEED), values))
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["False", "True"]


def test_lists_are_averaged():
    values = grid() | {
        f"twin.bend_amplitude_rad_{j}": [0.1 * j] * 12 for j in (1, 2, 3)
    }
    (axes,) = planes(draw(plot("line", F, "bend_amplitude_rad"), values))
    assert axes.get_ylabel() == "bend amplitude (rad), mean over 3"
    assert curves(axes)[0].get_ydata() == pytest.approx(0.2)
    (axes,) = planes(draw(plot("line", F, "bend_amplitude_rad_3"), values))
    assert curves(axes)[0].get_ydata() == pytest.approx(0.3)


NOTHING = [
    (table(np.zeros(0), np.zeros(0)), "there are no runs"),
    (table(np.ones(1), np.ones(1), failed=(0,)), "the run failed"),
    (grid(failed=range(12)), "all 12 runs failed"),
    (grid(missing=range(12)), "no value in 12 runs"),
    (grid(failed=(0, 1), missing=range(2, 12)), "no value in 10 runs, 2 failed"),
]


@pytest.mark.parametrize(("values", "message"), NOTHING)
@pytest.mark.parametrize("kind", ["line", "scatter"])
def test_a_plot_without_data_states_the_reason(values, message, kind, tmp_path):
    figure = draw(plot(kind, F, SPEED, by=P), values)
    assert f"nothing to draw: {message}" in words(figure)
    save(figure, tmp_path / "x.png")


def test_a_single_value_is_stated_and_shown():
    figure = draw(LINE, table(np.array([1.0]), np.array([30.0]), fraction=1.0))
    assert f"every value is {speed_at(1.0, 30.0):.4g}" in words(figure)
    assert curves(planes(figure)[0])[0].get_ydata() == pytest.approx(
        [speed_at(1.0, 30.0)]
    )


def test_invalid_plots_are_refused(tmp_path):
    with pytest.raises(
        UnknownNameError,
        match="unknown metric 'com_sped_m_s'; did you mean com_speed_m_s",
    ):
        draw(plot("line", F, "com_sped_m_s"), grid())
    with pytest.raises(
        UnknownNameError, match="unknown column 'supply.presure_kpa'; did you mean"
    ):
        draw(plot("line", F, SPEED, by="supply.presure_kpa"), grid())
    with pytest.raises(InputError, match=r"\.png or \.svg"):
        save(draw(LINE, grid()), tmp_path / "x.gif")
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        save(draw(LINE, grid()), tmp_path / "file/x.png")


def test_every_metric_has_a_label_with_its_unit():
    for metric, unit in (METRIC_UNITS | LIST_METRIC_UNITS | COMPARISON_UNITS).items():
        label = metric_label(metric)
        assert label.endswith(f"({unit})") == (unit != "1"), label
        assert "_" not in label, label
    assert metric_label("bend_amplitude_rad_2") == "bend amplitude 2 (rad)"


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("field", "label"),
    [
        (F, "gait frequency (Hz)"),
        (P, "supply pressure (kPa)"),
        (OFFSET, "steering offset"),
        ("duration_s", "simulated duration (s)"),
        ("plants.twin.timestep_s", "time step of the integrator, twin (s)"),
        ("plants.twin.wheels", "wheels or skids, twin"),
        ("robot.bending.stiffness_nm_per_rad", "bending stiffness (N·m/rad)"),
        ("robot.friction.mu_n", "friction μ_n"),
        ("robot", "robot"),
        ("pneumatics.leak_per_s", "pneumatics leak (1/s)"),
    ],
)
def test_fields_have_readable_labels(field, label):
    assert field_label(field) == label
