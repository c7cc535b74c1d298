"""A figure with panels and margins in inches. Matplotlib's automatic layouts double the time to draw."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure

_WIDTH = 9.0
_LEFT, _TOP, _BOTTOM = 0.75, 0.42, 0.5


def panels(
    height: float, rows: int = 1, *, right: float = 0.2, share_y: bool = False
) -> tuple[Figure, list[Axes]]:
    """Return a figure of the report's width and its panels, top first, with a common time axis.

    Args:
        height: of the whole figure, inches.
        rows: number of panels.
        right: margin for a second axis there, inches.
        share_y: whether all panels have the same range.
    """
    figure = Figure(figsize=(_WIDTH, height))
    margins = {
        "left": _LEFT / _WIDTH,
        "right": 1 - right / _WIDTH,
        "top": 1 - _TOP / height,
        "bottom": _BOTTOM / height,
        "hspace": 0.18,
    }
    made = figure.subplots(rows, 1, sharex=True, sharey=share_y, squeeze=False, gridspec_kw=margins)
    return figure, list(made[:, 0])


def finish(axes: Axes, label: str) -> None:
    """Name the y axis and lay a light grid."""
    axes.set_ylabel(label, fontsize=9)
    axes.grid(True, linewidth=0.4, alpha=0.5)
    axes.tick_params(labelsize=8)
