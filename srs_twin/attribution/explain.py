"""explain(): run the ladder of assumptions and split the gap between twin and analytical model."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from typing import Any

import numpy as np

from srs_twin.attribution.shapley import Contribution, contributions, subsets
from srs_twin.attribution.switches import Ladder
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.comparison.shares import MEASURES, Attribution, Share, gap_between
from srs_twin.errors import InputError
from srs_twin.plants.base import Plant
from srs_twin.rollout import rollout
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory

Progress = Callable[[float], None]


def explain(
    scenario: Scenario, trajectories: Mapping[str, Trajectory], *, progress: Progress | None = None
) -> Attribution:
    """Say why the two plants of a run differ.

    On the analytical side every subset of the assumptions that differ is run against the twin as it is, and
    each assumption's share averaged over the orders of switching (`shapley`). What the twin alone has is
    then refined, one at a time, against the model that has everything else in common with it. Shares and
    remainder add up to the gap.

    Args:
        scenario: what ran.
        trajectories: what both plants did, by name.
        progress: called with the part that is done, 0 to 1.

    Raises:
        InputError: one plant alone ran, or the runs have no whole gait periods to compare.
        DivergedError: one of the variants diverged.
    """
    if not {"analytical", "twin"} <= trajectories.keys():
        raise InputError("a difference needs two plants to be explained; run both")
    model, twin = trajectories["analytical"], trajectories["twin"]
    try:
        gap = gap_between(model, twin)
    except ValueError as error:
        raise InputError(f"{scenario.name}: {error}; three or more periods of a gait are needed") from error
    ladder = Ladder(scenario)
    names = [switch.name for switch in ladder.switches]
    sets = subsets(names)
    runs = _run_all(scenario, _variants(ladder, sets), progress)
    runs |= {_key(frozenset()): model, _key({}): twin}

    seen = {some: gap_between(runs[_key(some)], twin) for some in sets}
    found = contributions(names, seen)
    shares = [_share(switch.name, switch.title, "averaged", found[switch.name]) for switch in ladder.switches]
    alike = runs[_key(sets[-1])]
    for each in ladder.refinements:
        if each.plant == "twin":
            before, after = (gap_between(alike, runs[key]) for key in (_key(each.base), each.name))
        else:
            before, after = seen[sets[-1]], gap_between(runs[each.name], twin)
        value = each.factor * (after - before)
        shares.append(_share(each.name, each.title, "refined", Contribution(value, value, value)))
    remainder = gap - np.sum([share.value for share in shares], axis=0)
    ours = plant_metrics(model)
    return Attribution(
        reference=tuple(float(ours.get(name) or 0.0) for name in MEASURES),
        gap=_numbers(gap),
        shares=tuple(shares),
        remainder=_numbers(remainder),
        matched=_numbers(gap_between(runs["matched"], runs["stiff twin"])),
        same=tuple(ladder.same),
    )


def _variants(ladder: Ladder, sets: Sequence[frozenset[str]]) -> dict[str, Callable[[], Plant]]:
    """Return what has to run besides the two plants themselves, by name."""
    plants: dict[str, Callable[[], Plant]] = {"stiff twin": ladder.stiff_twin, "matched": ladder.matched}
    for some in sets[1:]:
        plants[_key(some)] = partial(ladder.analytical, some)
    for each in ladder.refinements:
        if each.plant == "analytical":
            plants[each.name] = partial(ladder.analytical, sets[-1], **each.options)
            continue
        plants[each.name] = partial(ladder.twin, each.change, **each.options)
        if each.base:
            plants.setdefault(_key(each.base), partial(ladder.twin, **each.base))
    return plants


def _key(switched: frozenset[str] | Mapping[str, Any]) -> str:
    """Return a name for the model with these switches on, or for the twin with these arguments."""
    plant = "model" if isinstance(switched, frozenset) else "twin"
    return f"{plant} with {', '.join(sorted(switched))}"


def _run_all(
    scenario: Scenario, plants: Mapping[str, Callable[[], Plant]], progress: Progress | None
) -> dict[str, Trajectory]:
    """Roll every plant out under the scenario's gait, on all processors."""

    def run(build: Callable[[], Plant]) -> Trajectory:
        return rollout(
            build(), scenario.build_controller(), scenario.duration, pose=scenario.pose, seed=scenario.seed,
            record_hz=scenario.record_hz,
        )  # fmt: skip

    found: dict[str, Trajectory] = {}
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        waiting = {pool.submit(run, build): name for name, build in plants.items()}
        try:
            for future in as_completed(waiting):
                found[waiting[future]] = future.result()
                if progress is not None:
                    progress(len(found) / len(waiting))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return found


def _share(name: str, title: str, how: str, found: Contribution) -> Share:
    """Return a share; what a switch takes off the gap is its share of it."""
    return Share(name, title, _numbers(-found.value), _numbers(-found.high), _numbers(-found.low), how)


def _numbers(values: Sequence[float] | np.ndarray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
