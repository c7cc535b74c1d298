"""Plots of studies: convergence, Pareto front, parallel coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill

import numpy as np
from matplotlib.figure import Figure

CaptionedFigure = tuple[Figure, str]
"""Figure and its caption."""


def draw_convergence(
    values: np.ndarray, feasible: np.ndarray, label: str, initial: float | None, *, maximize: bool
) -> CaptionedFigure:
    """Draw the objective of the twin's runs and the best feasible value so far.

    Args:
        values: objective of each run, shape (runs,).
        feasible: whether a run satisfies the constraints, shape (runs,).
        label: axis label of the objective.
        initial: value of the unmodified scenario.
        maximize: direction of the optimisation.
    """
    figure = Figure(figsize=(6.5, 3.4), layout="constrained")
    axes = figure.subplots()
    number = np.arange(1, len(values) + 1)
    best = (np.fmax if maximize else np.fmin).accumulate(np.where(feasible, values, np.nan))
    axes.plot(number[feasible], values[feasible], "o", color="#9aa5b1", markersize=4, label="each run")
    if not feasible.all():
        axes.plot(
            number[~feasible],
            values[~feasible],
            "x",
            color="#d5dae0",
            markersize=4,
            label="misses constraints",
        )
    axes.step(number, best, where="post", color="#1f6f8b", label="best so far")
    if initial is not None:
        axes.axhline(initial, color="#b5651d", linestyle="--", linewidth=1, label="initial scenario")
    axes.set(xlabel="runs of the twin", ylabel=label)
    axes.legend()
    return figure, "Convergence of the search: runs of the twin in order, and the best so far."


def draw_front(
    values: np.ndarray, front: np.ndarray, labels: Sequence[str], initial: Sequence[float | None]
) -> CaptionedFigure:
    """Draw the two objectives of all runs, shape (runs, 2), and the Pareto front."""
    figure = Figure(figsize=(6.5, 4.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(*values.T, "o", color="#9aa5b1", markersize=4, label="runs of the twin")
    axes.plot(*front.T, "o-", color="#1f6f8b", markersize=5, label="Pareto front")
    known = [value for value in initial if value is not None]
    if len(known) == 2:
        (start,) = axes.plot(known[:1], known[1:], "x", color="#b5651d", label="initial scenario")
        start.set(markersize=9, markeredgewidth=2)
    if values.size and np.nanmax(values[:, 1]) > 20 * np.nanmin(np.abs(values[:, 1])) > 0:
        axes.set_yscale("log")
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.legend()
    return figure, "Both objectives. No design is better in both than a design of the front."


def draw_parallel(
    shares: np.ndarray,
    ranks: np.ndarray,
    labels: Sequence[str],
    ends: Sequence[tuple[float, float]],
    bounds: Sequence[Sequence[str | None]],
) -> CaptionedFigure:
    """Draw designs as parallel coordinates, the better ones more prominently.

    Args:
        shares: variables as fractions of their ranges, shape (runs, d).
        ranks: rank of each run, shape (runs,).
        labels: labels of the variables.
        ends: (low, high) of each variable.
        bounds: for each variable, the bound ("low", "high" or None) of each best design.
    """
    count, places = len(shares), np.arange(shares.shape[1])
    figure = Figure(figsize=(max(6.5, 1.1 * len(places)), 3.6), layout="constrained")
    axes = figure.subplots()
    for k in np.argsort(-ranks):
        good = 1 - ranks[k] / max(count - 1, 1)
        color = "#1f6f8b" if ranks[k] < max(count // 10, 1) else "#9aa5b1"
        axes.plot(places, shares[k], "o-", color=color, alpha=0.15 + 0.85 * good, linewidth=1, markersize=3)
    marked = [(i, bound == "high") for i, names in enumerate(bounds) for bound in {*names} - {None}]
    if marked:
        axes.plot(*zip(*marked, strict=True), "D", color="#b03030", markersize=7, zorder=3, clip_on=False)
    named = zip(labels, ends, strict=True)
    axes.set_xticks(places, [f"{fill(label, 13)}\n{low:g} to {high:g}" for label, (low, high) in named])
    axes.set(yticks=[0, 1], yticklabels=["low", "high"], xlim=(-0.2, max(len(places) - 1, 0) + 0.2))
    caption = "Designs run by the twin; better ones are more opaque, the best tenth is blue."
    return figure, caption + (" Red: bounds on which a best design is." if marked else "")
