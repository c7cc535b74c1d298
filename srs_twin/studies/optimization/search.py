r"""Design optimisation with many low-fidelity runs and few high-fidelity runs.

The low-fidelity model is the analytical model `compliant`, and the high-fidelity model
is the twin. If `compliant` cannot simulate a scenario, the search uses only the twin.

**One objective.** CMA-ES (Hansen 2016) first optimises the designs with the
low-fidelity model, and the twin then simulates the best of these designs. A Gaussian
process fitted to the twin runs predicts the twin's results for other designs from their
variables and low-fidelity results (Kennedy and O'Hagan 2000). In each round, the twin
simulates two designs that maximise the expected improvement

$$ \mathrm{EI}(u) = σ \bigl(z Φ(z) + φ(z)\bigr) \prod_c P(c \text{ holds}), \qquad z =
(y^* - μ)/σ, $$

where μ and σ are the predicted mean and standard deviation of the cost of design u, and
y* is the lowest cost so far. The second design is selected under the assumption that
the first design yields its predicted result. The candidates are all designs that the
low-fidelity model has already simulated. In every round, many new designs are drawn
near the best designs and from the whole design space. Their low-fidelity results are
estimated by interpolation, and the low-fidelity model simulates the most promising of
them. Failed runs are excluded from all fits, and designs whose nearest run has failed
get an expected improvement of zero.

**Constraints.** CMA-ES avoids designs that violate a constraint in the low-fidelity
model, although they may satisfy it in the twin. A separate Gaussian process therefore
predicts each constrained metric of the twin. New designs are also drawn near designs
that slightly violate a constraint. Because active constraints may split the feasible
designs into regions with separate optima, the low-fidelity model also simulates designs
in the largest gaps between its earlier runs. With one objective, every second round
selects its second design for exploration. It maximises the expected improvement on the
best run of a region around one of the next best designs. These regions take turns.

**Budget.** After the last run, the maximum expected improvement over new designs is
computed. If it exceeds the fraction `MAX_IMPROVEMENT` of the best result, a warning is
issued.

**Two objectives.** CMA-ES minimises several Tchebycheff scalarisations with different
weights (Knowles 2006). The twin then simulates designs with the largest expected
increase in the area that the Pareto front dominates (Emmerich et al. 2006). Extending
an end of the front may hardly increase this area. The second design of every other
round therefore improves a single objective instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import cdist
from scipy.stats import norm

from srs_twin.errors import InputError
from srs_twin.studies.optimization.loading import OptimizationStudy
from srs_twin.studies.optimization.runs import Run, StudyRuns
from srs_twin.studies.sweep.points import sobol_points
from srs_twin.studies.sweep.task import DONE, Row
from srs_twin.studies.uncertainty.surrogates import GaussianProcess

_BATCH_SIZE = 2
"""Number of designs that the twin simulates per round."""

_NEIGHBOUR_STD = 0.08
"""Maximum standard deviation of new designs around the best designs, as a fraction of
each variable's range.
"""

_NEIGHBOURS = {1: 8, 2: 16}
"""Number of new candidates per round, keyed by the number of objectives."""

_INITIAL_FRACTION = 0.3
"""Fraction of the twin runs spent on the initial designs."""

_EDGE_OVERDRAW = 0.2
"""Distance by which random samples may exceed a variable's range before clipping, as a
fraction of the range.
"""

_MIN_DISTANCE = 1e-3
"""Distance below which two designs count as identical, with variables as fractions of
their ranges.
"""

MAX_REPORTED = 3
"""Maximum number of designs reported for a study with one objective."""

_OPTIMUM_DISTANCE = 0.1
"""Minimum distance between two reported designs, measured like `_MIN_DISTANCE`."""

_REGION_RADIUS = 0.1
"""Radius of an explored region, and minimum distance between the centres of such
regions, measured like `_MIN_DISTANCE`.
"""

_REGIONS = 4
"""Number of the best regions. The first one is not explored, because the other designs
of each round improve it.
"""

_CMA_FRACTION = 0.6
"""Fraction of the low-fidelity runs spent on random samples and CMA-ES."""

_POPULATION = 12

_SCREENED = 256
"""Number of designs that are drawn near the best designs in every round and screened
by interpolation. The same number is drawn from the whole design space.
"""

_EXPLORED = 2
"""Number of new candidates per round in the explored region, and number of candidates
that fill gaps, in a study with constraints.
"""

_MIN_FEASIBILITY = 0.1
"""Minimum probability that a candidate in a gap satisfies the constraints."""

_SMOOTHING = 1e-9
"""Smoothing parameter that keeps the linear system of the interpolation regular."""

MAX_IMPROVEMENT = 0.005
"""Expected improvement above which a warning is issued, as a fraction of the best
result.
"""

_IMPROVEMENT_DRAWS = 64
"""Number of random results drawn per candidate to estimate the expected increase in
the dominated area.
"""

_FAILURE_PENALTY_SD = 10.0
"""Penalty for violating a constraint by one standard deviation of the constrained
metric, in standard deviations of the objective.
"""


@dataclass(frozen=True)
class Optimum:
    """Result of a search.

    Attributes:
        best: twin runs of the best distinct designs, sorted from best to worst. With
            two objectives, these runs form the Pareto front and are sorted by the first
            objective.
        improvement: maximum expected improvement from one more twin run, as a fraction
            of the best result. The value is None for two objectives or without feasible
            runs.
    """

    best: tuple[Run, ...]
    runs: tuple[Run, ...]
    improvement: float | None = None


def search(study: OptimizationStudy, runs: StudyRuns) -> Optimum:
    """Search for the best designs within the run budget of a study."""
    state = _Search(study, runs)
    if "compliant" in study.experiments:
        state.search_compliant()
    state.run_initial_designs()
    while state.budget_left() > 0 and state.iterate():
        pass
    improvement = state.expected_improvement()
    return Optimum(state.best(), tuple(runs.requested), improvement)


def costs(study: OptimizationStudy, runs: Sequence[Run]) -> np.ndarray:
    """Return the objectives of runs as costs to minimise, shape (runs, objectives)."""
    goals = study.file.objectives
    return _signed(runs, [(goal.metric, goal.sign, 0.0) for goal in goals])


def excesses(study: OptimizationStudy, runs: Sequence[Run]) -> np.ndarray:
    """Return how far each run exceeds each constraint limit, shape (runs, limits).

    Satisfied constraints have zero or negative values.
    """
    limits = [
        (constraint.metric, sign, limit)
        for constraint in study.file.constraints
        for sign, limit in ((1.0, constraint.below), (-1.0, constraint.above))
        if limit is not None
    ]
    return _signed(runs, limits)


def _signed(
    runs: Sequence[Run], terms: Sequence[tuple[str, float, float]]
) -> np.ndarray:
    rows = [
        [sign * (run.metric(name) - offset) for name, sign, offset in terms]
        for run in runs
    ]
    return np.array(rows, dtype=float).reshape(len(runs), len(terms))


def front(costs: np.ndarray) -> np.ndarray:
    """Return a mask of the Pareto-optimal rows of a cost array, shape (rows,)."""
    dominated: np.ndarray = np.all(costs[None] <= costs[:, None], axis=2)
    dominated &= np.any(costs[None] < costs[:, None], axis=2)
    return np.asarray(~dominated.any(axis=1) & ~np.isnan(costs).any(axis=1))


def _cma() -> Any:
    try:
        import cma
    except ImportError as error:
        raise InputError(
            "the search needs the package cma; install it with: pip install"
            " 'srs-twin[optimize]'"
        ) from error
    return cma


class _Search:
    def __init__(self, study: OptimizationStudy, runs: StudyRuns) -> None:
        self._study = study
        self._runs = runs
        self._rng = np.random.default_rng((study.file.seed, 0x0F))
        self._size = study.space.size
        self._objectives = len(study.file.objectives)
        self._compliant_runs: list[Run] = []
        self._twin_runs: list[Run] = []
        self._is_constrained = bool(study.file.constraints)
        self._round = 0

    def search_compliant(self) -> None:
        cma = _cma()
        budget = int(_CMA_FRACTION * self._study.file.budget.compliant)
        weights = self._weights_of(
            np.linspace(0.02, 0.98, 7 if self._objectives > 1 else 1)
        )
        # Constraints may split the feasible designs into separate regions, and a search
        # with a single start may miss the best region. Random samples therefore use as
        # many runs as each CMA-ES search.
        sampled = max(2 * self._size, budget // (len(weights) + 1))
        self._run("compliant", self._sample_space(sampled))
        for k, weight in enumerate(weights):
            fraction = (budget - len(self._compliant_runs)) // (len(weights) - k)
            scalars = self._scalarise(self._compliant_runs, weight)
            start = self._compliant_runs[int(np.argmin(scalars))].fractions
            options = {
                "bounds": [0, 1],
                "seed": self._study.file.seed + 1 + k,
                "verbose": -9,
                "popsize": _POPULATION,
            }
            strategy = cma.CMAEvolutionStrategy(
                np.clip(start, 0.01, 0.99), 0.2, options
            )
            while fraction >= _POPULATION and not strategy.stop():
                designs = self._study.space.snapped(np.array(strategy.ask()))
                before = len(self._compliant_runs)
                runs = self._run("compliant", designs)
                values = self._scalarise(runs, weight, relative_to=self._compliant_runs)
                strategy.tell(list(designs), values.tolist())
                fraction -= max(len(self._compliant_runs) - before, 1)

    def run_initial_designs(self) -> None:
        budget = self._study.file.budget.twin
        count = max(int(_INITIAL_FRACTION * budget), min(4, budget))
        if not self._compliant_runs:
            self._run("twin", self._sample_space(max(count, 2 * self._size)))
            return
        random_designs = self._sample_space(max(count // 3, 1))
        chosen: list[np.ndarray] = []
        for weight in self._random_weights(count - len(random_designs)):
            order = np.argsort(self._scalarise(self._compliant_runs, weight))
            for design in (self._compliant_runs[k].fractions for k in order):
                if _is_far(design, chosen, _OPTIMUM_DISTANCE):
                    chosen.append(design)
                    break
        self._run("twin", np.array([*chosen, *random_designs]))

    @property
    def _improved_objective(self) -> int | None:
        """Index of the objective to improve, or None to increase the dominated area."""
        if self._objectives == 1:
            return 0
        return self._round // 2 % 2 if self._round % 2 else None

    @property
    def _explores(self) -> bool:
        """Whether the second design of this round is selected for exploration."""
        is_second_round = self._round % 2 == 0
        return self._objectives == 1 and self._is_constrained and is_second_round

    def budget_left(self) -> int:
        return self._study.file.budget.twin - len(self._twin_runs)

    def iterate(self) -> bool:
        """Simulate the best candidates, or return False if no candidate is left."""
        candidates = self._candidates()
        if not candidates:
            return False
        near_failures = self._near_failures([run.fractions for run in candidates])
        chosen: list[np.ndarray] = []
        assumed_costs = self._outputs(self._twin_runs)
        for k_batch in range(min(_BATCH_SIZE, self.budget_left())):
            if k_batch or self._objectives == 1:
                objective = self._improved_objective
            else:
                objective = None
            if k_batch == 0 or self._objectives == 2:
                mean, sd = self._predict(candidates, objective)
            score = self.improvement(mean, sd, assumed_costs, objective)
            score[near_failures] = 0.0
            score[[not _is_far(run.fractions, chosen) for run in candidates]] = -1.0
            k = int(np.argmax(score))
            if k_batch and self._explores:
                k = self._explored_candidate(candidates, mean, sd, chosen, k)
            if score[k] < 0:
                break
            chosen.append(candidates[k].fractions)
            assumed_costs = np.vstack([assumed_costs, mean[k]])
        self._run("twin", np.array(chosen))
        self._round += 1
        return True

    def _explored_candidate(
        self,
        candidates: list[Run],
        mean: np.ndarray,
        sd: np.ndarray,
        chosen: list[np.ndarray],
        otherwise: int,
    ) -> int:
        """Return the best candidate in the explored region, or else `otherwise`."""
        designs = np.array([run.fractions for run in candidates])
        score = self._regional_score(designs, mean, sd)
        score[[not _is_far(design, chosen) for design in designs]] = -1.0
        k = int(np.argmax(score))
        return k if score[k] > 0 else otherwise

    def _explored_region(self) -> np.ndarray:
        """Return the centre of the region that is explored in this round."""
        centres: list[np.ndarray] = []
        for k in np.argsort(self._scalarise(self._twin_runs, np.ones(1))):
            design = self._twin_runs[k].fractions
            if _is_far(design, centres, _REGION_RADIUS):
                centres.append(design)
        others = centres[1:_REGIONS] or centres
        return others[self._round // 2 % len(others)]

    def _regional_score(
        self, designs: np.ndarray, mean: np.ndarray, sd: np.ndarray
    ) -> np.ndarray:
        """Return the expected improvement on the best run in the explored region.

        The result is -1 for designs outside this region.
        """
        centre = self._explored_region()
        runs = [
            run
            for run in self._twin_runs
            if math.dist(run.fractions, centre) <= _REGION_RADIUS
        ]
        score = self.improvement(mean, sd, self._outputs(runs), 0)
        score[self._near_failures(designs)] = 0.0
        score[cdist(designs, [centre])[:, 0] > _REGION_RADIUS] = -1.0
        return score

    def expected_improvement(self) -> float | None:
        best = self.best()[:1]
        if self._objectives > 1 or (excesses(self._study, best) > 0).any():
            return None
        finished = [run.fractions for run in self._twin_runs]
        designs = self._study.space.snapped(self._screened_designs())
        new = np.array([design for design in designs if _is_far(design, finished)])
        if not len(new):
            return 0.0
        score = self._score(new, *self._predict_new(new))
        return float(score.max() / max(abs(costs(self._study, best)[0, 0]), 1e-12))

    def best(self) -> tuple[Run, ...]:
        """Return the best of the twin runs that violate the constraints least."""
        if self._objectives == 1:
            return self._distinct_optima(0)
        feasible = self._most_feasible()
        members = [
            feasible[k] for k in np.flatnonzero(front(costs(self._study, feasible)))
        ]
        return tuple(sorted(members, key=lambda run: costs(self._study, [run])[0, 0]))

    def _most_feasible(self) -> list[Run]:
        finished = [
            run for run in self._twin_runs if np.isfinite(self._outputs([run])).all()
        ]
        if not finished:
            reasons = (run.row.reason for run in self._twin_runs if run.row.reason)
            why = next(reasons, "the metrics of the study have no value")
            raise InputError(
                "the study cannot continue, because no run of the twin has a"
                f" result: {why}"
            )
        violations = np.maximum(excesses(self._study, finished), 0.0).sum(axis=1)
        return [
            run
            for run, violation in zip(finished, violations, strict=True)
            if violation <= violations.min()
        ]

    def _distinct_optima(self, objective: int) -> tuple[Run, ...]:
        feasible = self._most_feasible()
        chosen: list[Run] = []
        for k in np.argsort(costs(self._study, feasible)[:, objective]):
            others = [run.fractions for run in chosen]
            if len(chosen) < MAX_REPORTED and _is_far(
                feasible[k].fractions, others, _OPTIMUM_DISTANCE
            ):
                chosen.append(feasible[k])
        return tuple(chosen)

    def _run(self, part: str, designs: np.ndarray) -> list[Run]:
        runs = self._runs.run(part, designs)
        known = self._compliant_runs if part == "compliant" else self._twin_runs
        known_ids = {id(run) for run in known}
        new = {id(run): run for run in runs if id(run) not in known_ids}
        known += new.values()
        return runs

    def _sample_space(self, count: int) -> np.ndarray:
        """Return random designs, some of them on the bounds, shape (count, d)."""
        wide = (1 + 2 * _EDGE_OVERDRAW) * sobol_points(
            self._size, count, self._rng
        ) - _EDGE_OVERDRAW
        return self._study.space.snapped(np.clip(wide, 0.0, 1.0))

    def _random_weights(self, count: int) -> list[np.ndarray]:
        if self._objectives == 1:
            return self._weights_of(np.ones(count))
        return self._weights_of(
            self._rng.permutation((np.arange(count) + self._rng.random()) / count)
        )

    def _weights_of(self, fractions: np.ndarray) -> list[np.ndarray]:
        return [
            np.array([fraction, 1 - fraction] if self._objectives == 2 else [1.0])
            for fraction in fractions
        ]

    def _scalarise(
        self,
        runs: Sequence[Run],
        weight: np.ndarray,
        relative_to: Sequence[Run] | None = None,
    ) -> np.ndarray:
        """Return a penalised Tchebycheff scalarisation of the costs, shape (runs,)."""
        reference = runs if relative_to is None else relative_to
        reference_costs = costs(self._study, reference)
        known = reference_costs[~np.isnan(reference_costs).any(axis=1)]
        if not len(known):
            return np.zeros(len(runs))
        std = np.maximum(known.std(axis=0), 1e-12)
        weighted = weight * ((costs(self._study, runs) - known.min(axis=0)) / std)
        value = weighted.max(axis=1) + 0.05 * weighted.sum(axis=1)
        scale = np.maximum(np.nanstd(excesses(self._study, reference), axis=0), 1e-12)
        violations = np.maximum(excesses(self._study, runs) / scale, 0.0)
        value = value + _FAILURE_PENALTY_SD * violations.sum(axis=1)
        failed = _FAILURE_PENALTY_SD * (1 + np.nanmax(np.append(value, 0.0)))
        cost: np.ndarray = np.where(np.isnan(value), failed, value)
        return cost

    def _outputs(self, runs: Sequence[Run]) -> np.ndarray:
        return np.hstack([costs(self._study, runs), excesses(self._study, runs)])

    def _candidates(self) -> list[Run]:
        count = _NEIGHBOURS[self._objectives]
        if self._compliant_runs and self._objectives == 1:
            new = self._screened_candidates(count)
        else:
            new = self._neighbours(count)
        left = self._study.file.budget.compliant - len(self._compliant_runs)
        # Fewer than `count` designs are simulated only if no candidate is left otherwise.
        if (
            left > 0
            and self._compliant_runs
            and (count <= left or not self._untried(self._compliant_runs))
        ):
            self._run("compliant", self._study.space.snapped(new[:left]))
        candidates = self._compliant_runs
        if not candidates:
            designs = self._study.space.snapped(
                np.vstack([new, self._sample_space(256)])
            )
            candidates = [
                Run("twin", fractions, Row("", DONE)) for fractions in designs
            ]
        return self._untried(candidates)

    def _untried(self, candidates: Sequence[Run]) -> list[Run]:
        """Return the candidates that the twin has not simulated."""
        finished = [run.fractions for run in self._twin_runs]
        return [run for run in candidates if _is_far(run.fractions, finished)]

    def _screened_candidates(self, count: int) -> np.ndarray:
        screened = self._screened_designs()
        mean, sd = self._predict_new(screened)
        promising = screened[np.argsort(-self._score(screened, mean, sd))]
        if not self._is_constrained:
            return promising[:count]
        new = [*promising[: count - 2 * _EXPLORED], *self._regional_candidates()]
        # The interpolation may miss a narrow optimum between the low-fidelity runs, so
        # some candidates fill the largest gaps between them.
        known = [run.fractions for run in self._compliant_runs]
        possible = screened[self._feasibility(mean, sd) >= _MIN_FEASIBILITY]
        for _ in range(min(_EXPLORED, len(possible))):
            distance = cdist(possible, [*known, *new]).min(axis=1)
            new.append(possible[int(distance.argmax())])
        return np.array(new)

    def _regional_candidates(self) -> np.ndarray:
        """Return new designs in the explored region, shape (`_EXPLORED`, d)."""
        noise = self._rng.normal(size=(_SCREENED, self._size))
        drawn = self._explored_region() + _REGION_RADIUS / 2 * noise
        designs = self._study.space.snapped(np.clip(drawn, 0.0, 1.0))
        score = self._regional_score(designs, *self._predict_new(designs))
        return designs[np.argsort(-score)[:_EXPLORED]]

    def _screened_designs(self) -> np.ndarray:
        return np.vstack([self._neighbours(_SCREENED), self._sample_space(_SCREENED)])

    def _neighbours(self, count: int) -> np.ndarray:
        objective = self._improved_objective
        best = optima = self.best()
        if self._objectives == 1:
            # The penalised cost also ranks designs that slightly violate a constraint.
            best = best[:1]
            order = np.argsort(self._scalarise(self._twin_runs, np.ones(1)))
            optima = tuple(self._twin_runs[k] for k in order[:MAX_REPORTED])
        elif objective is not None:
            optima = self._distinct_optima(objective)
        parents = [
            runs[k]
            for runs in (optima, best)
            for k in self._rng.integers(len(runs), size=count // 2)
        ]
        centres = np.array([run.fractions for run in parents])
        std = _NEIGHBOUR_STD * 0.5 ** (self._rng.integers(0, 4, size=count))[:, None]
        new = np.clip(centres + std * self._rng.normal(size=centres.shape), 0.0, 1.0)
        # To reach other optima, every third design gets a new value for one variable.
        # This value is a bound in half of the cases, and otherwise any value in the
        # range.
        third = np.arange(0, count, 3)
        new[third, self._rng.integers(self._size, size=len(third))] = np.clip(
            self._rng.uniform(-0.5, 1.5, size=len(third)), 0.0, 1.0
        )
        return new

    def _predict_new(self, designs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predict as `_predict`, with interpolated low-fidelity results."""
        low_fidelity = None
        if self._compliant_runs:
            fractions = np.array([run.fractions for run in self._compliant_runs])
            outputs = self._outputs(self._compliant_runs)
            known = np.isfinite(outputs).all(axis=1)
            low_fidelity = np.full((len(designs), outputs.shape[1]), np.nan)
            if known.sum() > self._size + 1:
                low_fidelity = RBFInterpolator(
                    fractions[known], outputs[known], smoothing=_SMOOTHING
                )(designs)
        runs = [Run("twin", design, Row("", DONE)) for design in designs]
        return self._predict(runs, 0, low_fidelity)

    def _score(
        self, designs: np.ndarray, mean: np.ndarray, sd: np.ndarray
    ) -> np.ndarray:
        score = self.improvement(mean, sd, self._outputs(self._twin_runs), 0)
        score[self._near_failures(designs)] = 0.0
        return score

    def _near_failures(self, designs: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
        runs = [*self._twin_runs, *self._compliant_runs]
        failed = ~np.isfinite(self._outputs(runs)).all(axis=1)
        distances = cdist(designs, [run.fractions for run in runs])
        return np.asarray(failed[distances.argmin(axis=1)])

    def _predict(
        self,
        candidates: list[Run],
        objective: int | None,
        low_fidelity: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Predict outputs and their standard deviations, shape (candidates, outputs).

        If `low_fidelity` is None, the low-fidelity model simulates all candidates that
        have no low-fidelity result.
        """
        known = self._twin_runs
        outputs = self._outputs(known)
        scaled = self._compliant_outputs(candidates, low_fidelity)
        fractions = 2 * np.array([run.fractions for run in (*known, *candidates)]) - 1
        predictions = []
        for column in range(outputs.shape[1]):
            y = outputs[:, column]
            x = fractions
            if scaled is not None:
                x = np.column_stack([fractions, scaled[:, column]])
            rows = np.flatnonzero(np.isfinite(y))
            if column == objective:
                # Clipping the worst third of the results improves the fit near the
                # optimum, while the search still avoids these designs.
                order = rows[np.argsort(y[rows])]
                better = order[: max(2 * len(order) // 3, 2 * self._size + 2)]
                y = np.minimum(y, y[better[-1]])
            predictions.append(_predict_with_process(x[rows], y[rows], x[len(known) :]))
        mean, sd = np.array(predictions).transpose(1, 2, 0)
        return mean, sd

    def _compliant_outputs(
        self, candidates: list[Run], given: np.ndarray | None
    ) -> np.ndarray | None:
        if not self._compliant_runs:
            return None
        runs = [*self._twin_runs]
        if given is None:
            runs += candidates
        known = {run.fractions.tobytes(): run for run in self._compliant_runs}
        missing = [
            run.fractions for run in runs if run.fractions.tobytes() not in known
        ]
        if missing:
            known |= {
                run.fractions.tobytes(): run
                for run in self._run("compliant", np.array(missing))
            }
        outputs = self._outputs([known[run.fractions.tobytes()] for run in runs])
        if given is not None:
            outputs = np.vstack([outputs, given])
        # Clipping limits the effect of outliers on the linear part of the Gaussian
        # process.
        low, median, high = np.nanquantile(outputs, (0.05, 0.5, 0.95), axis=0)
        clipped = np.clip(outputs, 2 * low - median, 2 * high - median)
        outputs = np.where(np.isnan(outputs), median, clipped)
        return np.asarray((outputs - median) / np.maximum(high - low, 1e-12))

    def improvement(
        self,
        mean: np.ndarray,
        sd: np.ndarray,
        known: np.ndarray,
        objective: int | None = None,
    ) -> np.ndarray:
        """Return the expected improvement of each candidate, shape (candidates,).

        The predictions `mean` and `sd` and the twin results `known` have one column per
        output. If `objective` is None, the improvement is the increase in the dominated
        area.
        """
        count = self._objectives
        is_feasible = (known[:, count:] <= 0).all(axis=1)
        is_feasible &= np.isfinite(known).all(axis=1)
        if is_feasible.any():
            feasible = known[is_feasible, :count]
            if objective is not None:
                spread = sd[:, objective]
                z = (feasible[:, objective].min() - mean[:, objective]) / spread
                score = spread * (z * norm.cdf(z) + norm.pdf(z))
            else:
                normal = self._rng.normal(size=(_IMPROVEMENT_DRAWS, 1, 2))
                draws = mean[None, :, :2] + sd[None, :, :2] * normal
                score = area_gained(feasible, draws).mean(axis=0)
        else:
            score = np.ones(len(mean))
        return np.asarray(score * self._feasibility(mean, sd))

    def _feasibility(self, mean: np.ndarray, sd: np.ndarray) -> np.ndarray:
        """Return the probability that each design satisfies all constraints."""
        excess = mean[:, self._objectives :]
        spread = sd[:, self._objectives :]
        return np.asarray(norm.cdf(-excess / spread).prod(axis=1))


def area_gained(known: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the relative increase in the dominated area due to each point, shape (…).

    The area is bounded by a reference point, which exceeds the maximum costs of the
    front by its extents. The result is divided by the product of the extents.

    Args:
        known: costs of known designs, shape (designs, 2).
        points: costs of new designs, shape (…, 2).
    """
    members = known[front(known)]
    members = members[np.argsort(members[:, 0])]
    extent = np.maximum(
        np.ptp(members, axis=0), 1e-9 + 1e-3 * np.abs(members).max(axis=0)
    )
    reference = members.max(axis=0) + extent
    # Between two neighbouring points of the front, the boundary of the dominated area
    # lies at the second cost of the left point.
    edges = np.concatenate([[-np.inf], members[:, 0], [reference[0]]])
    level = np.concatenate([[reference[1]], members[:, 1]])
    width = np.clip(edges[1:] - np.maximum(points[..., :1], edges[:-1]), 0.0, None)
    height = np.clip(level - points[..., 1:], 0.0, None)
    return np.asarray((width * height).sum(axis=-1) / extent.prod())


def _predict_with_process(
    x: np.ndarray, y: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the means and standard deviations of a fitted Gaussian process.

    The standard deviations include the fitted noise. Because simulations are
    deterministic, this noise represents variation that more runs may resolve.
    """
    scale = max(float(y.std()), 1e-12)
    mean = float(y.mean())
    process = GaussianProcess(x, (y - mean) / scale)
    remainder = np.exp(2 * process.log_hyperparameters[2])
    variance = np.diag(process.covariance(at)) + remainder
    return mean + scale * process.at(at), scale * np.sqrt(np.maximum(variance, 1e-12))


def _is_far(
    design: np.ndarray, others: Sequence[np.ndarray], distance: float = _MIN_DISTANCE
) -> bool:
    return all(math.dist(design, other) > distance for other in others)
