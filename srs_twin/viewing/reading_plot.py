"""What the first segment's sensor reads over what it is bent by (Fig. 13c, 14e)."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from srs_twin.comparison.reading import ReadingCurve
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.colors import REFERENCE, style_of
from srs_twin.viewing.figures import finish, panels

_MOST_DOTS = 4000


def reading_plot(trajectories: Mapping[str, Trajectory]) -> Figure | None:
    """Return single readings (dots) and their mean at each bend, above it mean reading less bend.

    None where no run has a sensor other than an ideal one.
    """
    curves = {plant: ReadingCurve.of(run) for plant, run in trajectories.items()}
    drawn = {plant: curve for plant, curve in curves.items() if curve is not None}
    if not drawn:
        return None
    figure, (read, apart) = panels(4.6, 2)
    every = np.concatenate([curve.bend for curve in drawn.values()])
    ends = np.degrees([every.min(), every.max()]) if len(every) else np.zeros(2)
    read.plot(
        ends, ends, color=REFERENCE.color, linewidth=REFERENCE.width, linestyle=REFERENCE.dash, label="bend"
    )
    for index, (plant, curve) in enumerate(drawn.items()):
        style, run = style_of(plant, index), trajectories[plant]
        some = slice(None, None, math.ceil(len(run) / _MOST_DOTS))
        read.plot(
            np.degrees(run["bend_1"][some]), np.degrees(run["sensed_1"][some]), ".",
            color=style.color, markersize=1.5, alpha=0.3,
        )  # fmt: skip
        for axes, values in ((read, curve.reading), (apart, curve.reading - curve.bend)):
            axes.plot(
                np.degrees(curve.bend), np.degrees(values), color=style.color, linestyle=style.dash,
                linewidth=style.width, label=style.label,
            )  # fmt: skip
    finish(read, "sensed (°)")
    finish(apart, "mean less bend (°)")
    read.set_title("What the first segment's sensor reads (dots: single readings; lines: their means)",
                   fontsize=10, loc="left")  # fmt: skip
    handles, names = read.get_legend_handles_labels()
    read.legend(handles, names, loc="upper left", fontsize=8, frameon=False)
    apart.set_xlabel("bend (°)")
    return figure
