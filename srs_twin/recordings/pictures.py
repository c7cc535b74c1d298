"""Picture of a recording for `inspect`."""

from __future__ import annotations

from os.path import commonprefix
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from srs_twin.viewing.plots.style import GOAL_COLOR, PLUS_COLOR, finish, panels

if TYPE_CHECKING:
    from srs_twin.recordings.inspection import Scene


def markers_view(scene: Scene) -> Figure:
    """Plot the markers from above: paths, the chain at three times, rigid pairs, direction of motion."""
    places = scene.places
    low, high = np.nanmin(places, axis=(0, 1)), np.nanmax(places, axis=(0, 1))
    wide, deep = np.maximum(high - low, 1e-3)
    figure, (axes,) = panels(float(np.clip(8.0 * deep / wide + 1.4, 2.8, 7.0)))
    axes.plot(*places.reshape(len(places), -1, 2).transpose(2, 0, 1), color="0.8", linewidth=0.6, zorder=1)
    complete = np.flatnonzero(np.isfinite(places[..., 0]).all(axis=1))
    if complete.size:
        order = list(scene.order) or list(range(places.shape[1]))
        for moment, shade in zip(complete[[0, len(complete) // 2, -1]], ("0.55", "0.35", "0.1"), strict=True):
            along = places[moment, order]
            axes.plot(
                *along.T, "o-" if scene.order else "o", color=shade, markersize=4, linewidth=1.2, zorder=2
            )
            for pair in scene.rigid:
                axes.plot(*places[moment, list(pair)].T, color=PLUS_COLOR, linewidth=2.5, zorder=3)
        same = len(commonprefix(scene.names)) if len(scene.names) > 1 else 0
        for name, place in zip(scene.names, places[complete[0]], strict=True):
            said = name[same:] or name
            axes.annotate(said, place, (1, 4), textcoords="offset points", rotation=60, fontsize=7)
        start, end = (places[complete[k]].mean(axis=0) for k in (0, -1))
        if np.hypot(*(end - start)) > 0.05 * wide:
            axes.annotate(
                "", end, start, arrowprops={"arrowstyle": "->", "color": GOAL_COLOR, "linewidth": 1.2}
            )
    axes.set_aspect("equal", adjustable="datalim")
    title = f"{places.shape[1]} markers; lines: order along the body at the first, middle and last frame"
    finish(axes, "y (m)", "x (m)", title=title)
    return figure
