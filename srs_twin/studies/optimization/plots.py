"""Pictures of studies: how an optimum was found, Pareto fronts, which values good designs have."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure

Drawn = tuple[Figure, str]
"""A picture and what it shows."""


def draw_convergence(
    values: np.ndarray, kept: np.ndarray, label: str, begun: float | None, *, maximize: bool
) -> Drawn:
    """Draw what each run of the twin gave, shape (runs,), and the best so far of those that are kept."""
    figure = Figure(figsize=(6.5, 3.4), layout="constrained")
    axes = figure.subplots()
    number = np.arange(1, len(values) + 1)
    best = (np.fmax if maximize else np.fmin).accumulate(np.where(kept, values, np.nan))
    axes.plot(number[kept], values[kept], "o", color="#9aa5b1", markersize=4, label="each run")
    if not kept.all():
        axes.plot(
            number[~kept], values[~kept], "x", color="#d5dae0", markersize=4, label="misses constraints"
        )
    axes.step(number, best, where="post", color="#1f6f8b", label="best so far")
    if begun is not None:
        axes.axhline(begun, color="#b5651d", linestyle="--", linewidth=1, label="as it stands")
    axes.set(xlabel="runs of the twin", ylabel=label)
    axes.legend()
    return figure, "The search: runs of the twin in their order, and the best so far."


def draw_front(
    values: np.ndarray, front: np.ndarray, labels: Sequence[str], begun: Sequence[float | None]
) -> Drawn:
    """Draw two objectives of all runs, shape (runs, 2), and the Pareto front."""
    figure = Figure(figsize=(6.5, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(*values.T, "o", color="#9aa5b1", markersize=4, label="runs of the twin")
    axes.plot(*front.T, "o-", color="#1f6f8b", markersize=5, label="Pareto front")
    known = [each for each in begun if each is not None]
    if len(known) == 2:
        (start,) = axes.plot(known[:1], known[1:], "x", color="#b5651d", label="as it stands")
        start.set(markersize=9, markeredgewidth=2)
    if values.size and np.nanmax(values[:, 1]) > 20 * np.nanmin(np.abs(values[:, 1])) > 0:
        axes.set_yscale("log")
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.legend()
    return figure, "Both objectives: no design of the front is beaten in both by another one."


def draw_parallel(
    shares: np.ndarray,
    ranks: np.ndarray,
    labels: Sequence[str],
    ends: Sequence[tuple[float, float]],
    bounds: Sequence[Sequence[str | None]],
) -> Drawn:
    """Draw designs as lines over their variables, shape (runs, d), those of a low rank strongest.

    Args:
        shares: of the variables' ranges.
        ranks: of the runs, shape (runs,).
        labels: of the variables.
        ends: low and high of each variable.
        bounds: per variable, the bound ("low", "high" or None) on which each best design lies.
    """
    count, places = len(shares), np.arange(shares.shape[1])
    figure = Figure(figsize=(max(6.5, 1.1 * len(places)), 3.6), layout="constrained")
    axes = figure.subplots()
    for k in np.argsort(-ranks):
        good = 1 - ranks[k] / max(count - 1, 1)
        color = "#1f6f8b" if ranks[k] < max(count // 10, 1) else "#9aa5b1"
        axes.plot(places, shares[k], "o-", color=color, alpha=0.15 + 0.85 * good, linewidth=1, markersize=3)
    marked = [(i, bound == "high") for i, own in enumerate(bounds) for bound in {*own} - {None}]
    if marked:
        axes.plot(*zip(*marked, strict=True), "D", color="#b03030", markersize=7, zorder=3, clip_on=False)
    named = zip(labels, ends, strict=True)
    axes.set_xticks(places, [f"{fill(label, 13)}\n{low:g} to {high:g}" for label, (low, high) in named])
    axes.set(yticks=[0, 1], yticklabels=["low", "high"], xlim=(-0.2, max(len(places) - 1, 0) + 0.2))
    caption = "Designs that the twin ran: the better, the stronger; the best tenth in blue."
    return figure, caption + (" Red: bounds on which a best design lies." if marked else "")
