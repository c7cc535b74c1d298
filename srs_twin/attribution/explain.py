"""explain(): run the ladder of assumptions and split the gap between twin and analytical model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from srs_twin.attribution.shapley import Contribution, contributions, subsets
from srs_twin.attribution.switches import Ladder, Switch
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.comparison.shares import MEASURES, Attribution, Share, gap_between
from srs_twin.errors import DivergedError, InputError
from srs_twin.plants.base import Plant
from srs_twin.rollouts import Job, run_many
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
    if scenario.gap_factor:
        raise InputError(
            f"{scenario.name}: comparison.gap_factor scales a speed and leaves nothing to explain it by; "
            "take it out, rigid gaps are a switch of their own"
        )
    ladder = Ladder(scenario)
    first = frozenset(switch.name for switch in ladder.first)
    names = [switch.name for switch in ladder.switches]
    sets = [first | some for some in subsets(names)]
    runs = _run_all(scenario, _variants(ladder, sets), progress)
    runs |= {_key(frozenset()): model, _key({}): twin}

    seen = {some: gap_between(runs[_key(some)], twin) for some in sets}
    found = contributions(names, {some - first: value for some, value in seen.items()})
    shares = [_first_share(switch, seen[first] - gap) for switch in ladder.first]
    for switch in ladder.switches:
        shares.append(_share(switch.name, switch.title, "averaged", found[switch.name]))
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
    for some in (some for some in sets if some):
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
    jobs = [
        Job(
            build, scenario.build_controller, scenario.duration, scenario.pose, scenario.seed,
            scenario.record_hz,
        )
        for build in plants.values()
    ]  # fmt: skip
    told = None if progress is None else lambda done: progress(done / len(jobs))
    found: dict[str, Trajectory] = {}
    for name, run in zip(plants, run_many(jobs, progress=told), strict=True):
        if isinstance(run, DivergedError):
            run.args = (f"{scenario.name}: why they differ: {name}: {run}",)
            raise run
        found[name] = run
    return found


def _first_share(switch: Switch, change: np.ndarray) -> Share:
    return _share(switch.name, switch.title, "first", Contribution(change, change, change))


def _share(name: str, title: str, how: str, found: Contribution) -> Share:
    """Return a share; what a switch takes off the gap is its share of it."""
    return Share(name, title, _numbers(-found.value), _numbers(-found.high), _numbers(-found.low), how)


def _numbers(values: Sequence[float] | np.ndarray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)
