"""Colours, line styles and margins for all plots, and export to image files.

All plots use Matplotlib's default settings, so that the user's `matplotlibrc` file and
style sheets have no effect. Margins are fixed in inches, because Matplotlib's automatic
layouts double the drawing time.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib import colors, rc_context, rcParams, rcParamsDefault
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from srs_twin.errors import InputError
from srs_twin.io.files import atomic_write

Alignment = Literal["left", "center"]
_NO_PRESSURE = (225, 225, 222)
"""RGB colour of a segment without a pressure difference."""

PLUS_COLOR = "#aa3377"
"""Colour of segments with p⁺ > p⁻."""

MINUS_COLOR = "#009e73"
"""Colour of segments with p⁺ < p⁻."""

GOAL_COLOR = "#b03030"
OBJECT_COLOR = "#db8f38"
CONTACT_COLOR = "#55607a"
"""Colour of the points at which a spatial snake touches the floor."""


def rgb(color: str) -> tuple[int, int, int]:
    """Convert a colour #rrggbb to RGB bytes."""
    red, green, blue = bytes.fromhex(color[1:])
    return red, green, blue


unit_rgba = colors.to_rgba
"""Convert a colour #rrggbb to RGBA values from 0 to 1, as used by MuJoCo."""

PLUS_RGB = rgb(PLUS_COLOR)
MINUS_RGB = rgb(MINUS_COLOR)


@dataclass(frozen=True)
class Style:
    """Line style of a plant or another data source, with Okabe–Ito colours.

    Attributes:
        color: colour, #rrggbb.
        dash: Matplotlib line style, which distinguishes the plants in greyscale prints.
        width: line width, points.
    """

    label: str
    color: str
    dash: Literal["-", "--", "-.", ":"]
    width: float
    marker: str = "o"

    @property
    def rgb(self) -> tuple[int, int, int]:
        """Colour as RGB bytes."""
        return rgb(self.color)

    @property
    def line(self) -> dict[str, Any]:
        """Line style as keyword arguments for `Axes.plot`."""
        return {
            "color": self.color,
            "linestyle": self.dash,
            "linewidth": self.width,
            "label": self.label,
        }

    @property
    def zorder(self) -> float:
        """Drawing order, in which dashed lines lie above solid lines."""
        if self.dash == "-":
            return 2.0
        return 2.1


STYLES = {
    "twin": Style("twin (MuJoCo)", "#0072B2", "-", 1.7),
    "analytical": Style("analytical", "#D55E00", "--", 1.3, "s"),
    "measured": Style("measured", "#222222", ":", 1.8),
    "comparison": Style("twin − analytical", "#222222", "-.", 1.5, "D"),
    "plan": Style("plan", "#222222", "-", 1.5),
}
REFERENCE = Style("reference", "#000000", "-", 0.9)
"""Style of the reference bend."""

PUBLISHED_COLOR = "#000000"
"""Colour of published values."""

_FURTHER_COLORS = ("#CC79A7", "#56B4E9", "#E69F00")


def style_of(plant: str, index: int = 0) -> Style:
    """Return the style of a plant. For an unknown plant, `index` selects the colour."""
    return STYLES.get(plant) or Style(
        plant, _FURTHER_COLORS[index % len(_FURTHER_COLORS)], "-.", 1.5
    )


def pressure_colors(
    difference: np.ndarray, full_scale: float | None = None
) -> np.ndarray:
    """Return RGBA colours for pressure differences, shape (…, 4), uint8.

    The colour changes from light grey at 0 to purple for p⁺ > p⁻ and to green for
    p⁺ < p⁻.

    Args:
        difference: pressure difference p⁺ − p⁻, shape (…), or NaN.
        full_scale: pressure difference with the most saturated colour, by default the
            maximum magnitude of `difference`.
    """
    finite = np.nan_to_num(difference)
    if full_scale is None:
        full_scale = float(np.max(np.abs(finite), initial=0.0))
    fraction = np.clip(finite / max(full_scale, 1e-12), -1.0, 1.0)[..., None]
    full = np.where(fraction > 0, PLUS_RGB, MINUS_RGB)
    rgb = np.rint(_NO_PRESSURE + np.abs(fraction) * (full - np.array(_NO_PRESSURE)))
    return np.concatenate([rgb, np.full_like(fraction, 255)], axis=-1).astype(np.uint8)


# The backend does not affect figures, and reading the setting would import a backend.
_SETTINGS = {
    name: value for name, value in rcParamsDefault.items() if name != "backend"
}
# A fixed hash salt makes SVG files reproducible. Text is not converted to paths.
_SETTINGS |= {"svg.hashsalt": "srs-twin", "svg.fonttype": "none"}


@contextmanager
def own_settings() -> Iterator[None]:
    """Apply the Matplotlib settings of this package inside a `with` block."""
    # Only settings that differ are applied, because applying all settings takes 1 ms.
    with rc_context(
        {name: value for name, value in _SETTINGS.items() if rcParams[name] != value}
    ):
        yield


drawing = own_settings()
"""Decorator for drawing functions that applies `own_settings`."""

_WIDTH = 9.0
"""Width of all figures, inches."""

# Default margins for the title and the axis labels, inches.
_LEFT = 0.75
_TOP = 0.42
_BOTTOM = 0.5


def panels(height: float, rows: int = 1, **options: Any) -> tuple[Figure, list[Axes]]:
    """Create a figure with one column of panels that share the x axis.

    Args:
        height: figure height, inches.
        rows: number of panels.
        options: additional arguments of `side_by_side`.
    """
    figure, grid = side_by_side(height, 1, rows, space=0.18, sharex=True, **options)
    return figure, list(grid[:, 0])


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
    **options: Any,
) -> tuple[Figure, np.ndarray]:
    """Create a figure and a grid of panels, shape (rows, columns).

    Args:
        height: figure height, inches.
        columns: number of columns.
        rows: number of rows.
        left: left margin, inches.
        right: right margin, inches.
        top: top margin, inches.
        bottom: bottom margin, inches.
        space: gap between panels as a fraction of the panel size.
        options: additional arguments of `Figure.subplots`.
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
    return figure, figure.subplots(
        rows, columns, squeeze=False, gridspec_kw=margins, **options
    )


def set_title(axes: Axes, title: str, loc: Alignment = "center") -> None:
    """Set the title of a panel at a fixed height.

    Matplotlib's automatic placement would take a tenth of the drawing time.
    """
    axes.set_title(title, fontsize=10, loc=loc, y=1.0)


def finish(
    axes: Axes,
    label: str,
    x_label: str = "",
    *,
    title: str = "",
    loc: Alignment = "center",
) -> None:
    """Add axis labels, a title and a grid to a panel."""
    axes.set_ylabel(label, fontsize=9)
    if x_label:
        axes.set_xlabel(x_label)
    if title:
        set_title(axes, title, loc)
    axes.grid(True, linewidth=0.4, alpha=0.5)
    axes.tick_params(labelsize=8)


def finish_floor(axes: Axes, title: str = "") -> None:
    """Give a panel that shows the floor equal scales, axis labels, title and grid."""
    axes.set_aspect("equal", adjustable="datalim")
    finish(axes, "y (m)", "x (m)", title=title)


def add_legend(target: Axes | Figure, loc: Any = "best", **options: Any) -> None:
    """Add a legend without a frame to a panel or a figure."""
    target.legend(loc=loc, frameon=False, **{"fontsize": 8} | options)


FORMATS = (".png", ".svg")


@drawing
def save(figure: Figure, path: str | Path, dpi: float = 130) -> None:
    """Atomically write a figure as SVG, or as PNG with `dpi` pixels per inch.

    Equal figures yield identical files.
    """
    target = Path(path)
    if target.suffix not in FORMATS:
        raise InputError(
            f"{target.name}: the file name of an image must end in"
            f" {' or '.join(FORMATS)}"
        )
    if target.suffix == ".png":
        metadata = {"Software": None}
    else:
        metadata = {"Date": None}
    with atomic_write(target) as temporary:
        figure.savefig(temporary, format=target.suffix[1:], dpi=dpi, metadata=metadata)
