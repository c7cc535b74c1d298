"""Colours, lines and margins, the same in every picture.

Colours and lines, the same in every picture: of the plants, and of a segment's pressures.

A figure with panels and margins in inches. Matplotlib's automatic layouts double the time to draw.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

_NO_PRESSURE = (225, 225, 222)
# Neither is a plant's colour.
PLUS_RGB = (170, 51, 119)
MINUS_RGB = (0, 158, 115)


@dataclass(frozen=True)
class Style:
    """How one plant looks in every picture (Okabe and Ito's palette, safe for the colour-blind).

    Attributes:
        label: name in legends.
        color: as #rrggbb.
        dash: matplotlib line style; differs between plants so that grey print can be read.
        width: line width, points.
    """

    label: str
    color: str
    dash: Literal["-", "--", "-.", ":"]
    width: float

    @property
    def rgb(self) -> tuple[int, int, int]:
        """The colour as three bytes."""
        value = int(self.color[1:], 16)
        return value >> 16, value >> 8 & 255, value & 255

    @property
    def zorder(self) -> float:
        """Dashed lines lie on solid ones: where both agree, both are seen."""
        return 2.0 if self.dash == "-" else 2.1


STYLES = {
    "twin": Style("twin (MuJoCo)", "#0072B2", "-", 1.7),
    "analytical": Style("analytical", "#D55E00", "--", 1.3),
    "measured": Style("measured", "#222222", ":", 1.8),
}
REFERENCE = Style("reference", "#000000", "-", 0.9)
"""What the bends are to follow."""

PUBLISHED_COLOR = "#000000"
"""Of values from a publication; its marker is no plant's either."""

_MORE = ("#CC79A7", "#56B4E9", "#E69F00")


def style_of(plant: str, index: int = 0) -> Style:
    """Return a plant's style; names that are not known take a further colour by their index."""
    return STYLES.get(plant) or Style(plant, _MORE[index % len(_MORE)], "-.", 1.5)


def pressure_colors(difference: np.ndarray) -> np.ndarray:
    """Return RGBA bytes, shape (…, 4): purple for p⁺ above p⁻, green below, light grey between.

    Args:
        difference: p⁺ − p⁻, any unit; the largest magnitude has the full colour, NaN is grey.
    """
    known = np.nan_to_num(difference)
    share = (known / max(float(np.max(np.abs(known), initial=0.0)), 1e-12))[..., None]
    full = np.where(share > 0, PLUS_RGB, MINUS_RGB)
    rgb = np.rint(_NO_PRESSURE + np.abs(share) * (full - np.array(_NO_PRESSURE)))
    return np.concatenate([rgb, np.full_like(share, 255)], axis=-1).astype(np.uint8)


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
