"""How far each plant is from the measured robot, over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

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
    """Return the residuals of what was measured of shape, path, heading and bends (RMS over segments)."""
    signals = {plant: difference.signals() for plant, difference in differences.items()}
    shown = [name for name in _LABELS if all(name in each for each in signals.values())]
    labels = [*(_LABELS[name][0] for name in shown), "bends (rad)"]
    figure, rows = panels(0.9 + 1.45 * len(labels), len(labels))
    for index, (plant, difference) in enumerate(differences.items()):
        style = style_of(plant, index)
        values = [*(_LABELS[name][1] * signals[plant][name] for name in shown), difference.bend_rms]
        for axes, each in zip(rows, values, strict=True):
            axes.plot(
                difference.comparison.time, each, color=style.color, linestyle=style.dash,
                linewidth=style.width, label=style.label,
            )  # fmt: skip
    for axes, label in zip(rows, labels, strict=True):
        finish(axes, label)
    distances = "shapes and paths as distances, " if shown else ""
    rows[0].set_title(f"Plant less measured: {distances}bends RMS over segments", fontsize=10)
    rows[0].legend(loc="upper left", fontsize=8, frameon=False)
    rows[-1].set_xlabel("time (s)")
    return figure
