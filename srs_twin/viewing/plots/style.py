"""Colours, lines and margins, the same in every picture.

Margins are given in inches: matplotlib's automatic layouts double the time to draw.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

Place = Literal["left", "center"]
_NO_PRESSURE = (225, 225, 222)
# Of pressures; neither is a plant's colour.
PLUS_COLOR, MINUS_COLOR = "#aa3377", "#009e73"
GOAL_COLOR = "#b03030"


def rgb(color: str) -> tuple[int, int, int]:
    """Return a colour #rrggbb as three bytes."""
    red, green, blue = bytes.fromhex(color[1:])
    return red, green, blue


def unit_rgba(color: str, alpha: float = 1.0) -> tuple[float, float, float, float]:
    """Return a colour #rrggbb as MuJoCo takes it: red, green, blue, opacity, 0 to 1."""
    red, green, blue = rgb(color)
    return red / 255, green / 255, blue / 255, alpha


PLUS_RGB, MINUS_RGB = rgb(PLUS_COLOR), rgb(MINUS_COLOR)


@dataclass(frozen=True)
class Style:
    """How one plant, or what is said of both, looks in every picture (Okabe and Ito's palette).

    Attributes:
        label: name in legends.
        color: as #rrggbb.
        dash: matplotlib line style; differs between plants so that grey print can be read.
        width: line width, points.
        marker: of points.
    """

    label: str
    color: str
    dash: Literal["-", "--", "-.", ":"]
    width: float
    marker: str = "o"

    @property
    def rgb(self) -> tuple[int, int, int]:
        """The colour as three bytes."""
        return rgb(self.color)

    @property
    def line(self) -> dict[str, Any]:
        """Arguments of `Axes.plot`."""
        return {"color": self.color, "linestyle": self.dash, "linewidth": self.width, "label": self.label}

    @property
    def zorder(self) -> float:
        """Dashed lines lie on solid ones: where both agree, both are seen."""
        return 2.0 if self.dash == "-" else 2.1


STYLES = {
    "twin": Style("twin (MuJoCo)", "#0072B2", "-", 1.7),
    "analytical": Style("analytical", "#D55E00", "--", 1.3, "s"),
    "measured": Style("measured", "#222222", ":", 1.8),
    "comparison": Style("twin − analytical", "#222222", "-.", 1.5, "D"),
    "plan": Style("plan", "#222222", "-", 1.5),
}
REFERENCE = Style("reference", "#000000", "-", 0.9)
"""What the bends are to follow."""

PUBLISHED_COLOR = "#000000"
"""Of values from a publication; its marker is no plant's either."""

_MORE = ("#CC79A7", "#56B4E9", "#E69F00")


def style_of(plant: str, index: int = 0) -> Style:
    """Return a plant's style; names that are not known take a further colour by their index."""
    return STYLES.get(plant) or Style(plant, _MORE[index % len(_MORE)], "-.", 1.5)


def pressure_colors(difference: np.ndarray, most: float | None = None) -> np.ndarray:
    """Return RGBA bytes, shape (…, 4): purple for p⁺ above p⁻, green below, light grey between.

    Args:
        difference: p⁺ − p⁻, any unit; NaN is grey.
        most: which magnitude has the full colour; default the largest one.
    """
    known = np.nan_to_num(difference)
    most = float(np.max(np.abs(known), initial=0.0)) if most is None else most
    share = np.clip(known / max(most, 1e-12), -1.0, 1.0)[..., None]
    full = np.where(share > 0, PLUS_RGB, MINUS_RGB)
    rgb = np.rint(_NO_PRESSURE + np.abs(share) * (full - np.array(_NO_PRESSURE)))
    return np.concatenate([rgb, np.full_like(share, 255)], axis=-1).astype(np.uint8)


_WIDTH = 9.0
_LEFT, _TOP, _BOTTOM = 0.75, 0.42, 0.5


def panels(
    height: float, rows: int = 1, *, right: float = 0.2, share_y: bool = False, heights: Sequence[float] = ()
) -> tuple[Figure, list[Axes]]:
    """Return a figure of the report's width and its panels, top first, with a common time axis.

    Args:
        height: of the whole figure, inches.
        rows: number of panels.
        right: margin for a second axis there, inches.
        share_y: whether all panels have the same range.
        heights: of the panels over each other; default equal ones.
    """
    figure, made = side_by_side(
        height, 1, rows, right=right, space=0.18, sharex=True, sharey=share_y, height_ratios=heights or None
    )
    return figure, list(made[:, 0])


def side_by_side(
    height: float,
    columns: int,
    rows: int = 1,
    *,
    left: float = _LEFT,
    right: float = 0.2,
    top: float = _TOP,
    bottom: float = _BOTTOM,
    space: float = 0.08,
    **shared: Any,
) -> tuple[Figure, np.ndarray]:
    """Return a figure of the report's width and its panels, shape (rows, columns).

    Args:
        height: of the whole figure, inches.
        columns: number of panels in a row.
        rows: number of rows.
        left: margin there, inches.
        right: margin there, inches.
        top: margin there, inches.
        bottom: margin there, inches.
        space: between panels, over their size.
        shared: what `Figure.subplots` is told besides.
    """
    figure = Figure(figsize=(_WIDTH, height))
    margins = {
        "left": left / _WIDTH,
        "right": 1 - right / _WIDTH,
        "top": 1 - top / height,
        "bottom": bottom / height,
        "hspace": space,
        "wspace": space,
    }
    return figure, figure.subplots(rows, columns, squeeze=False, gridspec_kw=margins, **shared)


def finish(axes: Axes, label: str, below: str = "", *, title: str = "", loc: Place = "center") -> None:
    """Name the axes and lay a light grid.

    Args:
        axes: of a panel.
        label: of the y axis.
        below: label of the x axis.
        title: above the panel.
        loc: where it stands, "center" or "left".
    """
    axes.set_ylabel(label, fontsize=9)
    if below:
        axes.set_xlabel(below)
    if title:
        axes.set_title(title, fontsize=10, loc=loc)
    axes.grid(True, linewidth=0.4, alpha=0.5)
    axes.tick_params(labelsize=8)
