"""How far each plant is from the measured robot, over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.viewing.colors import style_of
from srs_twin.viewing.figures import finish, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from srs_twin.comparison.measured import MeasuredDifference

_LABELS = {
    "shape_m": ("shape (mm)", 1e3),
    "path_m": ("CoM path (mm)", 1e3),
    "heading_rad": ("heading (rad)", 1),
}


def measured_plot(differences: Mapping[str, MeasuredDifference]) -> Figure:
    """Return the residuals of shape, path, heading and bends (RMS over segments) of each plant."""
    figure, rows = panels(6.6, 4)
    for index, (plant, difference) in enumerate(differences.items()):
        style = style_of(plant, index)
        time = difference.comparison.time
        signals = difference.signals()
        bends = np.sqrt((difference.comparison.bend_error**2).mean(axis=1))
        shown = [scale * signals[name] for name, (_, scale) in _LABELS.items()] + [bends]
        for axes, values in zip(rows, shown, strict=True):
            axes.plot(
                time, values, color=style.color, linestyle=style.dash, linewidth=style.width,
                label=style.label,
            )  # fmt: skip
    for axes, label in zip(rows, [*(label for label, _ in _LABELS.values()), "bends (rad)"], strict=True):
        finish(axes, label)
    rows[0].set_title(
        "Plant less measured: shapes and paths as distances, bends RMS over segments", fontsize=10
    )
    rows[0].legend(loc="upper left", fontsize=8, frameon=False)
    rows[-1].set_xlabel("time (s)")
    return figure
