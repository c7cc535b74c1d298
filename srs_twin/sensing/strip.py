r"""A magnet and a Hall element on the strip in a segment's neutral axis: field at the element against bend.

The strip bends with constant curvature κ = q/l. The frame sits where the magnet does: x along the strip
towards the element and the head, y normal to it, to the left. At the arc length L the strip has turned by
θ = κL; the element stands h_s and the magnet's centre h_m to the left of the neutral axis (both less than
0 on its other side):

$$ S = \begin{pmatrix} \sin\theta/\kappa - h_s \sin\theta \\
(1 - \cos\theta)/\kappa + h_s \cos\theta \end{pmatrix}, \qquad
M = \begin{pmatrix} 0 \\ h_m \end{pmatrix}. $$

The magnet is a point dipole with moment m, along y (`up`) or x (`side`), seen from r = S − M:

$$ B = \frac{\mu_0}{4\pi}\left(\frac{3\,(m\cdot r)\,r}{|r|^5} - \frac{m}{|r|^3}\right), $$

and the element measures what is normal to it, B_n = B_y cos θ − B_x sin θ (Eq. 1). θ in Eq. 1 is taken to
be the local angle κL: with the whole bend in its place a reading over ±90° would not be linear, let alone
monotonic (docs/sensor.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.sensing.chamber import PRESSED, felt_bend

ORIENTATIONS = ("up", "side")
"""Where the magnet's north pole points: normal to the strip (the text's choice), or along it."""

_MU0_4PI = 1e-7  # T·m/A

INCH = 0.0254
"""m."""

MAGNET_HEIGHT = INCH / 32
"""Height of the magnet, a cylinder, m (Section 2.2.2)."""

MAGNET_DIAMETER = INCH / 16
"""Its diameter, m. Estimate: a stock size of that height; the text gives none."""

REMANENCE = 1.32
"""T. Estimate: NdFeB of grade N42, 1.29 to 1.33 T in makers' tables; the text names no grade."""

MOMENT = REMANENCE * math.pi / 4 * MAGNET_DIAMETER**2 * MAGNET_HEIGHT / (4 * math.pi * _MU0_4PI)
"""Magnetic moment, A·m²: remanence times volume over μ₀, 1.65e-3."""


@dataclass(frozen=True)
class Strip:
    """A magnet and a Hall element on a strip (module docstring).

    The heights are estimates: half of the flexible board (0.05 mm) and half of the magnet; the board and
    0.65 mm up to the element within a SOT-23 package. The text gives none.

    Attributes:
        segment_length: l, the length that bends by q, m.
        distance: L, arc length from magnet to element, m. The text chose 3.1 mm, of 3.1 to 4.6 mm studied.
        orientation: of the magnet, one of `ORIENTATIONS`.
        moment: |m|, A·m².
        magnet_height: h_m, m.
        element_height: h_s, m.
        chamber: cross-section of the pressure chambers, one of `chamber.PRESSED`; a rectangular one presses
            on the strip.
    """

    segment_length: float
    distance: float = 0.0031
    orientation: str = "up"
    moment: float = MOMENT
    magnet_height: float = 0.05e-3 + MAGNET_HEIGHT / 2
    element_height: float = 0.7e-3
    chamber: str = "semicircular"

    def __post_init__(self) -> None:
        if self.orientation not in ORIENTATIONS:
            raise UnknownNameError("magnet orientation", self.orientation, ORIENTATIONS)
        if self.chamber not in PRESSED:
            raise UnknownNameError("chamber cross-section", self.chamber, PRESSED)
        for name in ("segment_length", "distance", "moment"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"{name} {value!r} is not allowed; it must be finite and above 0")
        if self.distance > self.segment_length:
            raise InputError(
                f"distance {self.distance:g} m from magnet to element is not allowed; "
                f"the segment is {self.segment_length:g} m long"
            )
        for name in ("magnet_height", "element_height"):
            value = getattr(self, name)
            if not abs(value) < self.distance / math.pi:
                raise InputError(
                    f"{name} {value!r} m is not allowed; at this distance it must be within "
                    f"±{self.distance / math.pi:.3g} m, or magnet and element meet when the strip bends"
                )


def dipole(x: np.ndarray, y: np.ndarray, m_x: float, m_y: float) -> tuple[np.ndarray, np.ndarray]:
    """Return B_x and B_y (T) of a dipole in the plane of its moment.

    Args:
        x: place seen from the dipole, m, any shape.
        y: same shape, m; not 0 where x is.
        m_x: moment, A·m².
        m_y: A·m².
    """
    square = x * x + y * y
    cube = square * np.sqrt(square)
    along = 3 * (m_x * x + m_y * y) / square
    return _MU0_4PI * (along * x - m_x) / cube, _MU0_4PI * (along * y - m_y) / cube


def element_place(bend: np.ndarray | float, strip: Strip) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x and y of the element seen from the magnet (r, m) and the angle θ it has turned by, rad.

    Arguments as in `field`.
    """
    theta = felt_bend(np.asarray(bend, dtype=float), strip.chamber) * (strip.distance / strip.segment_length)
    theta = np.where(np.abs(theta) <= math.pi, theta, np.nan)
    # (sin θ, 1 − cos θ)/κ as a chord at θ/2, smooth through κ = 0; np.sinc has π inside.
    chord = strip.distance * np.sinc(theta / (2 * math.pi))
    x = chord * np.cos(theta / 2) - strip.element_height * np.sin(theta)
    y = chord * np.sin(theta / 2) + strip.element_height * np.cos(theta) - strip.magnet_height
    return x, y, theta


def field(bend: np.ndarray | float, strip: Strip) -> np.ndarray:
    """Return the field normal to the element, B_n, T.

    Args:
        bend: q of the segment, rad, any shape. Where it is no number, or bends the strip between magnet
            and element by more than half a turn, so is the result (NaN).
        strip: where magnet and element are.
    """
    x, y, theta = element_place(bend, strip)
    m_x, m_y = (0.0, strip.moment) if strip.orientation == "up" else (strip.moment, 0.0)
    b_x, b_y = dipole(x, y, m_x, m_y)
    normal: np.ndarray = b_y * np.cos(theta) - b_x * np.sin(theta)
    return normal
