"""What a snake under iterative learning learns: amplitudes, targets and duties by period (Fig. 48, 50)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from srs_twin.comparison.chamber_periods import ChamberPeriods
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.colors import MINUS_RGB, PLUS_RGB, style_of
from srs_twin.viewing.figures import finish

_SIDES = ("+", "\u2212")
_COLORS = tuple("#{:02x}{:02x}{:02x}".format(*rgb) for rgb in (PLUS_RGB, MINUS_RGB))
_MOST_ROWS = 8
_HEIGHT, _WIDTH, _MARGIN = 1.35, 9.0, 0.95


def learning_plot(trajectories: Mapping[str, Trajectory]) -> Figure:
    """Return a row a module, eight at most: amplitudes with their targets on the left, duties on the right.

    The chambers differ in colour, the plants in dash; targets are thin and dotted.
    """
    runs = {plant: ChamberPeriods.of(run) for plant, run in trajectories.items()}
    rows = min(_MOST_ROWS, max(run.duty.shape[1] for run in runs.values()))
    height = _HEIGHT * rows + _MARGIN
    figure = Figure(figsize=(_WIDTH, height))
    panels = figure.subplots(
        rows, 2, sharex=True, sharey="col", squeeze=False,
        gridspec_kw={
            "left": 0.083, "right": 0.978, "top": 1 - 0.45 / height, "bottom": 0.5 / height, "hspace": 0.18,
            "wspace": 0.18,
        },
    )  # fmt: skip
    for j, (bends, duties) in enumerate(panels):
        for index, (plant, run) in enumerate(runs.items()):
            dash = style_of(plant, index).dash
            for side, color in enumerate(_COLORS):
                _line(bends, run.amplitude[:, j, side], color, dash, 1.4)
                _line(bends, run.target[:, j, side], color, ":", 0.8)
                _line(duties, run.duty[:, j, side], color, dash, 1.4)
        duties.set_ylim(-0.04, 1.04)
        finish(bends, f"segment {j + 1}\n(rad)")
        finish(duties, "duty")
    panels[0, 0].set_title("Amplitudes (dotted: targets)", fontsize=10, loc="left")
    panels[0, 1].set_title("Duties", fontsize=10, loc="left")
    for axes in panels[-1]:
        axes.set_xlabel("period of the chamber")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.legend(handles=_keys(trajectories), loc="upper right", ncols=4, fontsize=8, frameon=False)
    return figure


def _line(axes: Axes, values: np.ndarray, color: str, dash: str, width: float) -> None:
    axes.plot(np.arange(1, len(values) + 1), values, color=color, linestyle=dash, linewidth=width)


def _keys(trajectories: Mapping[str, Trajectory]) -> list[Line2D]:
    chambers = [
        Line2D([], [], color=color, label=f"{side} chamber")
        for side, color in zip(_SIDES, _COLORS, strict=True)
    ]
    styles = [style_of(plant, index) for index, plant in enumerate(trajectories)]
    return chambers + [Line2D([], [], color="0.4", linestyle=each.dash, label=each.label) for each in styles]
