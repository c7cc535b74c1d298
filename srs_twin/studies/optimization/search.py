r"""Search over two fidelities: many runs of `compliant`, few of the twin.

One objective: CMA-ES (Hansen 2016) on the cheap model finds where good designs are. There the twin runs
first; from then on a Gaussian process of what the twin gives, by design and cheap result (Kennedy and
O'Hagan 2000), says of new designs how much better they may be,

$$ \mathrm{EI}(u) = σ \bigl(z Φ(z) + φ(z)\bigr) \prod_c P(c \text{ holds}), \qquad z = (y^* - μ)/σ, $$

and the best two run at a time, as if the first had turned out as expected. Candidates are what the cheap
model has run, and fresh neighbours of the best designs in every round.

Two objectives: the cheap model is searched with several weights of a Tchebycheff scalarisation (Knowles
2006); then it is the area that the Pareto front beats whose growth is expected (Emmerich et al. 2006), and in
turns what one of its two ends may improve by: a long way for a little area is soon left to others.

Where `compliant` cannot run a scenario the twin is searched alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

from srs_twin.errors import InputError
from srs_twin.studies.optimization.loading import Study
from srs_twin.studies.optimization.runs import Run, Runs
from srs_twin.studies.sweep.task import DONE, Row
from srs_twin.studies.uncertainty.surrogates import GaussianProcess

_TOGETHER = 2
_NEAR, _AROUND = 0.08, {1: 8, 2: 16}
"""Spread of fresh candidates about the best designs; how many each round, by the number of objectives."""
_FIRST = 0.3
"""Share of the twin's budget that the cheap model alone decides."""
_BEYOND = 0.2
_APART = 1e-3
TOLD, _OTHERS = 3, 0.1
"""Designs that are told of, so far from each other."""
_CHEAP = 0.6
"""Share of the cheap budget that CMA-ES has; the rest is for candidates."""
_POPULATION = 12
_DRAWS = 64
"""Of what a candidate may give, for two objectives."""
_LOST = 10.0
"""What a failed run counts, in standard deviations of the others."""


@dataclass(frozen=True)
class Optimum:
    """What a search found.

    Attributes:
        best: runs of the twin: the best one and others that are apart from it, the better first; with two
            objectives the Pareto front, by the first of them.
        runs: all of them in their order.
    """

    best: tuple[Run, ...]
    runs: tuple[Run, ...]


def search(study: Study, runs: Runs) -> Optimum:
    """Find the best designs within the budget.

    Args:
        study: what is asked.
        runs: who runs designs.

    Raises:
        InputError: no run of the twin has a result, or a row cannot be kept.
    """
    asked = _Search(study, runs)
    if "compliant" in study.experiments:
        asked.cheaply()
    asked.first()
    while asked.left() and asked.more():
        pass
    return Optimum(asked.best(), tuple(runs.asked))


def costs(study: Study, runs: Sequence[Run]) -> np.ndarray:
    """Return the objectives of runs, all to be as small as can be, shape (runs, objectives); NaN: none."""
    signs = [-1.0 if each.goal == "maximize" else 1.0 for each in study.file.objectives]
    found = [
        [s * run.metric(o.metric) for s, o in zip(signs, study.file.objectives, strict=True)] for run in runs
    ]
    return np.array(found, dtype=float).reshape(len(runs), len(signs))


def excesses(study: Study, runs: Sequence[Run]) -> np.ndarray:
    """Return by how much runs miss each constraint, below 0 where it is kept, shape (runs, limits)."""
    rows = []
    for run in runs:
        row = []
        for each in study.file.constraints:
            value = run.metric(each.metric)
            row += [value - each.below] if each.below is not None else []
            row += [each.above - value] if each.above is not None else []
        rows.append(row)
    return np.array(rows, dtype=float).reshape(len(runs), -1)


def front(costs: np.ndarray) -> np.ndarray:
    """Return which rows no other row is better than in all columns, shape (rows,)."""
    better: np.ndarray = np.all(costs[None] <= costs[:, None], axis=2)
    better &= np.any(costs[None] < costs[:, None], axis=2)
    return np.asarray(~better.any(axis=1) & ~np.isnan(costs).any(axis=1))


def _cma() -> Any:
    """Return the package cma.

    Raises:
        InputError: it is not installed.
    """
    try:
        import cma
    except ImportError as error:
        raise InputError("optimize needs cma; install it with: pip install 'srs-twin[optimize]'") from error
    return cma


class _Search:
    def __init__(self, study: Study, runs: Runs) -> None:
        self._study, self._runs = study, runs
        self._rng = np.random.default_rng((study.file.seed, 0x0F))
        self._size, self._many = study.space.size, len(study.file.objectives)
        self._cheap: list[Run] = []
        self._costly: list[Run] = []
        self._round = 0

    def cheaply(self) -> None:
        """Search the cheap model, once for one objective, for two with different weights."""
        cma = _cma()
        budget = int(_CHEAP * self._study.file.budget.compliant)
        weights = (
            [np.ones(1)] if self._many == 1 else [np.array([w, 1 - w]) for w in np.linspace(0.02, 0.98, 7)]
        )
        self._try("compliant", self._spread(max(2 * self._size, budget // 10)))
        for k, weight in enumerate(weights):
            share = (budget - len(self._cheap)) // (len(weights) - k)
            start = self._cheap[int(np.argmin(self._scalars(self._cheap, weight)))].shares
            options = {
                "bounds": [0, 1],
                "seed": self._study.file.seed + 1 + k,
                "verbose": -9,
                "popsize": _POPULATION,
            }
            strategy = cma.CMAEvolutionStrategy(np.clip(start, 0.01, 0.99), 0.2, options)
            while share >= _POPULATION and not strategy.stop():
                designs = self._study.space.settled(np.array(strategy.ask()))
                before = len(self._cheap)
                found = self._try("compliant", designs)
                strategy.tell(list(designs), self._scalars(found, weight, among=self._cheap).tolist())
                share -= max(len(self._cheap) - before, 1)

    def first(self) -> None:
        """Run the twin where the cheap model is best, and at some designs apart."""
        count = max(int(_FIRST * self._study.file.budget.twin), min(4, self._study.file.budget.twin))
        if not self._cheap:
            self._try("twin", self._spread(max(count, 2 * self._size)))
            return
        apart = self._spread(max(count // 3, 1))
        chosen: list[np.ndarray] = []
        for weight in self._weights(count - len(apart)):
            order = np.argsort(self._scalars(self._cheap, weight))
            designs = (self._cheap[k].shares for k in order)
            other = next((d for d in designs if _far(d, chosen, _OTHERS)), None)
            if other is not None:
                chosen.append(other)
        self._try("twin", np.array([*chosen, *apart]))

    @property
    def _turn(self) -> int | None:
        """The objective that this round is for, of two one end of their front; None: the whole front."""
        if self._many == 1:
            return 0
        return self._round // 2 % 2 if self._round % 2 else None

    def left(self) -> int:
        """Return how many runs of the twin may still come."""
        return self._study.file.budget.twin - len(self._costly)

    def more(self) -> bool:
        """Run the twin where it is expected to improve most; say whether there was anything left to run."""
        candidates = self._candidates()
        if not candidates:
            return False
        chosen: list[np.ndarray] = []
        believed = self._told(self._costly)
        for turn in range(min(_TOGETHER, self.left())):
            end = self._turn if turn or self._many == 1 else None
            if turn == 0 or self._many == 2:
                at = self._predicted(self._costly, candidates, end)
            score = self._improvement(*at, believed, end)
            score[[not _far(run.shares, chosen) for run in candidates]] = -1.0
            k = int(np.argmax(score))
            if score[k] < 0:
                break
            chosen.append(candidates[k].shares)
            believed = np.vstack([believed, at[0][k]])  # as if it had turned out as expected
        self._try("twin", np.array(chosen))
        self._round += 1
        return True

    def best(self) -> tuple[Run, ...]:
        """Return the best runs of the twin; those that keep the constraints best where none does.

        Raises:
            InputError: none has a result.
        """
        if self._many == 1:
            return self._hills(0)
        kept = self._kept()
        members = [kept[k] for k in np.flatnonzero(front(costs(self._study, kept)))]
        return tuple(sorted(members, key=lambda run: costs(self._study, [run])[0, 0]))

    def _kept(self) -> list[Run]:
        """Return the runs of the twin that keep the constraints best; raises as `best`."""
        ran = [run for run in self._costly if np.isfinite(self._told([run])).all()]
        if not ran:
            why = next(
                (run.row.reason for run in self._costly if run.row.reason), "its metrics are not there"
            )
            raise InputError(f"no run of the twin has a result: {why}")
        excess = np.maximum(excesses(self._study, ran), 0.0).sum(axis=1)
        return [run for run, miss in zip(ran, excess, strict=True) if miss <= excess.min()]

    def _hills(self, objective: int) -> tuple[Run, ...]:
        """Return the best runs of the twin by one objective that are apart from each other."""
        kept, chosen = self._kept(), list[Run]()
        for k in np.argsort(costs(self._study, kept)[:, objective]):
            if _far(kept[k].shares, [run.shares for run in chosen], _OTHERS) and len(chosen) < TOLD:
                chosen.append(kept[k])
        return tuple(chosen)

    def _try(self, part: str, designs: np.ndarray) -> list[Run]:
        found = self._runs.run(part, designs)
        mine = self._cheap if part == "compliant" else self._costly
        there = {id(run) for run in mine}
        mine += [run for run in {id(run): run for run in found}.values() if id(run) not in there]
        return found

    def _spread(self, count: int) -> np.ndarray:
        from scipy.stats import qmc

        drawn = qmc.Sobol(self._size, rng=self._rng).random_base2(max(count - 1, 1).bit_length())
        # What is best lies at a bound more often than not: a share of the designs does, too.
        return self._study.space.settled(np.clip((1 + 2 * _BEYOND) * drawn[:count] - _BEYOND, 0.0, 1.0))

    def _weights(self, count: int) -> list[np.ndarray]:
        if self._many == 1:
            return [np.ones(1)] * count
        return [
            np.array([w, 1 - w])
            for w in self._rng.permutation((np.arange(count) + self._rng.random()) / count)
        ]

    def _scalars(
        self, runs: Sequence[Run], weight: np.ndarray, among: Sequence[Run] | None = None
    ) -> np.ndarray:
        """Return one number a run, the smaller the better; what misses constraints or failed comes last."""
        others = runs if among is None else among
        own, all_of = costs(self._study, runs), costs(self._study, others)
        known = all_of[~np.isnan(all_of).any(axis=1)]
        if not len(known):
            return np.zeros(len(runs))
        low, wide = known.min(axis=0), np.maximum(known.std(axis=0), 1e-12)
        scaled = (own - low) / wide
        value = (weight * scaled).max(axis=1) + 0.05 * (weight * scaled).sum(axis=1)
        limits, given = excesses(self._study, runs), excesses(self._study, others)
        if limits.size:
            size = np.maximum(np.nanstd(given, axis=0), 1e-12)
            value = value + _LOST * np.maximum(limits / size, 0.0).sum(axis=1)
        return np.where(np.isnan(value), _LOST * (1 + np.nanmax(np.append(value, 0.0))), value)

    def _told(self, runs: Sequence[Run]) -> np.ndarray:
        """Return costs and excesses of runs, shape (runs, outputs)."""
        return np.hstack([costs(self._study, runs), excesses(self._study, runs)])

    def _candidates(self) -> list[Run]:
        """Return designs that the twin may run: what the cheap model has run, and neighbours of the best."""
        count = _AROUND[self._many]
        hills = self.best() if self._turn is None else self._hills(self._turn)
        best = hills[:1] if self._many == 1 else self.best()
        parents = [of[k] for of in (hills, best) for k in self._rng.integers(len(of), size=count // 2)]
        about = np.array([run.shares for run in parents])
        near = _NEAR * 0.5 ** (self._rng.integers(0, 4, size=count))[:, None]
        fresh = np.clip(about + near * self._rng.normal(size=about.shape), 0.0, 1.0)
        # A third has one variable anywhere, as often as not at a bound: other hills begin there.
        far = np.arange(0, count, 3)
        fresh[far, self._rng.integers(self._size, size=len(far))] = np.clip(
            self._rng.uniform(-0.5, 1.5, size=len(far)), 0.0, 1.0
        )
        if self._cheap and len(self._cheap) + count <= self._study.file.budget.compliant:
            self._try("compliant", self._study.space.settled(fresh))
        there = self._cheap
        if not there:
            everywhere = self._study.space.settled(np.vstack([fresh, self._spread(256)]))
            there = [Run("twin", shares, Row("", DONE)) for shares in everywhere]
        ran = [run.shares for run in self._costly]
        return [run for run in there if _far(run.shares, ran)]

    def _predicted(
        self, known: list[Run], candidates: list[Run], end: int | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return means and standard deviations of what the twin would give, shape (candidates, outputs).

        `end` is the objective of which only the best matters; None: there is no such one.
        """
        told, cheap = self._told(known), self._cheaper([*known, *candidates])
        shares = 2 * np.array([run.shares for run in (*known, *candidates)]) - 1
        found = []
        for column in range(told.shape[1]):
            y, x = told[:, column], shares
            if cheap is not None:
                x = np.column_stack([shares, cheap[:, column]])
            there = np.flatnonzero(np.isfinite(y))
            if column == end:
                # Only what is near to the best matters; far off, results would bend the process.
                order = there[np.argsort(y[there])]
                there = order[: max(2 * len(order) // 3, 2 * self._size + 2)]
            found.append(_process(x[there], y[there], x[len(known) :]))
        mean, sd = np.array(found).transpose(1, 2, 0)
        return mean, sd

    def _cheaper(self, runs: Sequence[Run]) -> np.ndarray | None:
        """Return what the cheap model says of the designs of runs, scaled, shape (runs, outputs)."""
        if not self._cheap:
            return None
        there = {run.shares.tobytes(): run for run in self._cheap}
        missing = [run.shares for run in runs if run.shares.tobytes() not in there]
        if missing:
            there |= {run.shares.tobytes(): run for run in self._try("compliant", np.array(missing))}
        told = self._told([there[run.shares.tobytes()] for run in runs])
        low, middle, high = np.nanquantile(told, (0.05, 0.5, 0.95), axis=0)
        told = np.where(np.isnan(told), middle, np.clip(told, 2 * low - middle, 2 * high - middle))
        return np.asarray((told - middle) / np.maximum(high - low, 1e-12))

    def _improvement(
        self, mean: np.ndarray, sd: np.ndarray, known: np.ndarray, end: int | None = None
    ) -> np.ndarray:
        """Return the expected improvement of each candidate over what is known, shape (candidates,).

        `end` is the objective that is to improve; None: both, by the area.
        """
        many, one = self._many, end
        kept = (known[:, many:] <= 0).all(axis=1) & np.isfinite(known).all(axis=1)
        if kept.any():
            best = known[kept, :many]
            if one is not None:
                z = (best[:, one].min() - mean[:, one]) / sd[:, one]
                score = sd[:, one] * (z * norm.cdf(z) + norm.pdf(z))
            else:
                drawn = mean[None, :, :2] + sd[None, :, :2] * self._rng.normal(size=(_DRAWS, 1, 2))
                score = area_gained(best, drawn).mean(axis=0)
        else:
            score = np.ones(len(mean))
        holds = norm.cdf(-mean[:, many:] / sd[:, many:]).prod(axis=1)
        return np.asarray(score * holds)


def area_gained(known: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return by how much points enlarge the area that known ones beat, shape (…) of points (…, 2).

    Both columns are costs; the area ends as far beyond the front as that extends: its ends may grow as well.
    """
    members = known[front(known)]
    members = members[np.argsort(members[:, 0])]
    extent = np.maximum(np.ptp(members, axis=0), 1e-9 + 1e-3 * np.abs(members).max(axis=0))
    worst = members.max(axis=0) + extent
    # Between neighbours of the front the second cost to beat is that of the left one.
    edges = np.concatenate([[-np.inf], members[:, 0], [worst[0]]])
    level = np.concatenate([[worst[1]], members[:, 1]])
    wide = np.clip(edges[1:] - np.maximum(points[..., :1], edges[:-1]), 0.0, None)
    high = np.clip(level - points[..., 1:], 0.0, None)
    return np.asarray((wide * high).sum(axis=-1) / extent.prod())


def _process(x: np.ndarray, y: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of a Gaussian process at inputs."""
    scale, middle = max(float(y.std()), 1e-12), float(y.mean())
    process = GaussianProcess(x, (y - middle) / scale)
    variance = np.diag(process.covariance(at))
    return middle + scale * process.at(at), scale * np.sqrt(np.maximum(variance, 1e-12))


def _far(design: np.ndarray, others: Sequence[np.ndarray], by: float = _APART) -> bool:
    return all(math.dist(design, other) > by for other in others)
