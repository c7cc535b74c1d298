"""Figure of the transient after a change of offset: curvature over time, and the path.

    uv run python benchmarks/transient_figure.py --plot docs/images/transient.png

Generation 4 with learning, offset −0.3 to 0.3, on both plants. The path begins at the
change. It is compared with the arc of an instantaneous change (the assumption of the
dissertation), and with the measured jump of the footprint followed by the new arc.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from transient import Turned, turned

from srs_twin.io.files import atomic_write
from srs_twin.planning.arcs import arc_end
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.viewing.plots.style import finish, style_of

CASE = ("ilc_curve", -0.3, 0.3, 24.0)
FOOTPRINT = "gen4_ilc"
SHOWN_PERIODS = (-1.5, 6.0)
SHOWN_M = 0.7
_ASSUMED = "0.55"
_JUMPED = "0.15"


def draw(runs: dict[str, Turned], footprint: Footprint, path: Path) -> None:
    """Draw both panels.

    Args:
        runs: runs by plant.
        footprint: footprint of the same change of offset.
        path: output file (PNG).
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for plant, run in runs.items():
        style = style_of(plant)
        look = {"color": style.color, "linestyle": style.dash, "linewidth": style.width}
        shown = (run.periods >= SHOWN_PERIODS[0]) & (run.periods <= SHOWN_PERIODS[1])
        left.plot(run.periods[shown], run.curvature[shown], label=style.label, **look)
        right.plot(*run.path(SHOWN_M).T, **look)
    _assumptions(left, right, footprint)
    finish(left, "curvature over one period (1/m)")
    left.set_xlabel("periods after the change of offset, −0.3 to 0.3")
    left.legend(fontsize=8, frameon=False)
    finish(right, "y (m)")
    right.set_xlabel("x (m), the path at the change along x")
    right.set_aspect("equal", adjustable="datalim")
    right.legend(fontsize=8, frameon=False)
    with atomic_write(path) as part:
        figure.savefig(part, format="png", dpi=130, metadata={"Software": None})


def _assumptions(left: Axes, right: Axes, footprint: Footprint) -> None:
    """Draw the instantaneous change, and the measured jump with the new arc."""
    before, after = CASE[1:3]
    old, new = (
        float(np.interp(o, footprint.offsets, footprint.curvatures))
        for o in (before, after)
    )
    times = (SHOWN_PERIODS[0], 0.0, SHOWN_PERIODS[1])
    look = {"color": _ASSUMED, "zorder": 0}
    left.step(times, (old, new, new), where="post", label="instant change", **look)
    jump = next(
        t for t in footprint.transients if (t.before, t.after) == (before, after)
    )
    # The steady arc is the path after the transient.
    for start, begin, color, words in (
        ((0.0, 0.0, 0.0), 0.0, _ASSUMED, "instant change"),
        (
            (jump.dx, jump.dy, jump.dheading),
            jump.length,
            _JUMPED,
            "measured jump, steady arc",
        ),
    ):
        arc = np.array(
            [arc_end(*start, new, s)[:2] for s in np.linspace(begin, SHOWN_M, 60)]
        )
        right.plot(
            *arc.T,
            color=color,
            linewidth=1.0,
            linestyle=":" if begin else "-",
            label=words,
            zorder=3,
        )
    right.plot(0, 0, "k.", markersize=5)
    right.annotate(
        f"jump: {math.degrees(jump.dheading):.0f}°, {1e3 * jump.dy:.0f} mm",
        (0.02, 0.02),
        xycoords="axes fraction",
        fontsize=8,
    )


def main() -> None:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    options.add_argument("--plot", type=Path, required=True, metavar="FILE")
    selected = options.parse_args()
    runs = {
        plant: turned(CASE[0], plant, *CASE[1:]) for plant in ("analytical", "twin")
    }
    draw(runs, load_footprint(FOOTPRINT), selected.plot)


if __name__ == "__main__":
    main()
