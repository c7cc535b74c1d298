r"""Analysis of the assumptions that cause the difference between the two plants.

A switch replaces one assumption of the analytical model with the corresponding
assumption of the twin. Each subset S of the switches defines a variant of the model,
and v(S) is the difference between this variant and the twin. The contribution of switch
i is its Shapley value φ_i, the mean change of v over all n! switching orders:

$$ \phi_i = \sum_{S \not\ni i} \frac{|S|!\,(n - |S| - 1)!}{n!}\,\bigl[v(S \cup i) - v(S)\bigr]. $$

The contributions add up to the difference between v with all switches and v without
switches. An approximation that only one plant makes, such as a finite time step, cannot
be switched. Instead, the approximation is refined, and the effect of the refinement is
extrapolated to the exact limit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from srs_twin.comparison.compare import (
    MEASURES,
    AssumptionShare,
    Attribution,
    gap_between,
)
from srs_twin.comparison.contacts import contact_free_s
from srs_twin.comparison.metrics import MainCause, plant_metrics
from srs_twin.compute.workers import processor_count, run_tasks
from srs_twin.control.base import Controller
from srs_twin.errors import DivergedError, InputError
from srs_twin.plants.base import Plant
from srs_twin.plants.twin.mjcf.numerics import (
    Numerics,
    PreloadedContact,
    stable_step,
    stated,
)
from srs_twin.robot.file import RobotFile
from srs_twin.robot.friction import TWO_POINT_LAWS
from srs_twin.robot.spec import RobotSpec
from srs_twin.rollout import Job, rollout, run_many
from srs_twin.scenario.plants import AnalyticalFile, TwinFile
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory


@dataclass(frozen=True)
class Contribution:
    """Mean, minimum and maximum contribution of a switch over all switching orders."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


def subsets(names: Sequence[str]) -> list[frozenset[str]]:
    """Return all subsets of the names, sorted by size."""
    return [
        frozenset(subset)
        for size in range(len(names) + 1)
        for subset in combinations(names, size)
    ]


def contributions(
    names: Sequence[str], differences: Mapping[frozenset[str], np.ndarray]
) -> dict[str, Contribution]:
    """Return the contribution of each switch, computed from all differences v(S)."""
    n = len(names)
    shapley = {}
    for name in names:
        others = subsets([other for other in names if other != name])
        changes = [
            differences[subset | {name}] - differences[subset] for subset in others
        ]
        # The weight is the fraction of switching orders in which exactly this subset
        # precedes the switch.
        weights = [
            math.factorial(len(subset))
            * math.factorial(n - len(subset) - 1)
            / math.factorial(n)
            for subset in others
        ]
        value = np.sum(
            [w * change for w, change in zip(weights, changes, strict=True)], axis=0
        )
        shapley[name] = Contribution(
            value, np.min(changes, axis=0), np.max(changes, axis=0)
        )
    return shapley


FROZEN_CHORDS = "frozen chords"
MATCHED_STIFFNESS_FACTOR = 45.0
"""Ratio of the stiff twin's bending stiffness to the bending stiffness of the robot.

For the robot gen2, the stiffness increases from 0.44 to 20 N·m/rad. Loads hardly
deflect such stiff segments, so their bends match those of the analytical model.
"""


class Switch(NamedTuple):
    """Assumption of the model that can be replaced with the assumption of the twin.

    Attributes:
        name: short name.
        title: assumption of the model and assumption of the twin, separated by an
            arrow.
        differs: whether model and twin make different assumptions in the scenario.
        options: arguments of the analytical model that activate the switch. Later
            switches override the arguments of earlier switches.
    """

    name: str
    title: str
    differs: bool
    options: Mapping[str, object]


@dataclass(frozen=True)
class Refinement:
    """Refinement of an approximation that only one plant makes.

    For a first-order error, the factor is 2 if the step is halved and 4/3 if the step
    is quartered. For a second-order error, the factor is 4/3 if the step is halved. The
    factor is 1 if the refinement removes the approximation.

    Attributes:
        name: short name.
        title: description of the approximation.
        options: plant arguments that implement the refinement.
        factor: total effect of the approximation divided by the effect of the
            refinement.
        plant: plant that makes the approximation, "twin" or "analytical".
        base: plant arguments of the run with which the refined run is compared.
    """

    name: str
    title: str
    options: Mapping[str, object]
    factor: float
    plant: str = "twin"
    base: Mapping[str, object] = field(default_factory=dict)


class PlantVariants:
    """Variants of a scenario's plants with switched assumptions or refinements.

    Attributes:
        all_switches: all switches, in the order in which their options are applied.
        first: list of the switch from chords to arcs, which is activated before all
            others, or an empty list.
        switches: remaining switches whose assumptions differ between the plants.
        first_on: names of the switches in `first`.
        sets: sets of active switches to simulate, sorted by size.
        same: names of the assumptions that both plants share.
        refinements: one refinement for each approximation that only one plant makes.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._model = scenario.file.plants.analytical or AnalyticalFile()
        self._twin = scenario.file.plants.twin or TwinFile()
        self.all_switches = self._all_switches()
        differing = [switch for switch in self.all_switches if switch.differs]
        self.first = [switch for switch in differing if switch.name == FROZEN_CHORDS]
        self.switches = [switch for switch in differing if switch.name != FROZEN_CHORDS]
        self.first_on = frozenset(switch.name for switch in self.first)
        names = [switch.name for switch in self.switches]
        self.sets = [self.first_on | subset for subset in subsets(names)]
        self.same = [switch.name for switch in self.all_switches if not switch.differs]
        self.refinements = self._refinements()

    def _all_switches(self) -> list[Switch]:
        gaps = self._twin.gaps
        inertia = self._model.inertia
        return [
            *self._contact_switches(),
            Switch(
                "rigid gaps",
                f"rigid gaps: {self._model.gaps} → {gaps}",
                self._model.gaps != gaps,
                {"gaps": gaps},
            ),
            *self._bend_switches(),
            Switch(
                "connector inertia",
                f"yaw inertia of a connector: {inertia} → compact",
                inertia != "connector",
                {"inertia": "connector"},
            ),
        ]

    def _contact_switches(self) -> list[Switch]:
        spec = self._scenario.robot
        friction = self._model.friction
        friction_law = self._twin.friction_law
        half_track = spec.geometry.half_track
        one_point = spec.skin is None and friction not in TWO_POINT_LAWS
        return [
            Switch(
                "friction law",
                f"friction law: {friction} → {friction_law}",
                spec.skin is None and friction != friction_law,
                {"friction": friction_law, "track": 0.0 if one_point else half_track},
            ),
            Switch(
                "wheel track",
                "contacts: one point per connector → two at the track",
                one_point,
                {"track": half_track},
            ),
        ]

    def _bend_switches(self) -> list[Switch]:
        spec = self._scenario.robot
        model = self._model.model
        damping_time = spec.bending.damping_time
        prescribed = model != "compliant"
        return [
            Switch(
                FROZEN_CHORDS,
                "frozen chords (without friction torque) → arcs",
                model == "simplified",
                {"friction_torque": True, "model": "complete"},
            ),
            Switch(
                "compliance",
                "bends: prescribed → compliant",
                prescribed,
                {"friction_torque": True, "model": "compliant"},
            ),
            Switch(
                "damping",
                f"damping c/k: τ₂ → {1e3 * damping_time:g} ms",
                prescribed and damping_time != spec.actuator.tau_mode,
                {},
            ),
        ]

    def _contact_refinements(self) -> list[Refinement]:
        contact = self._twin.build_contact().for_robot(self._scenario.robot)
        if isinstance(contact, PreloadedContact):
            stiffer = replace(
                contact,
                slip_time=stated(contact.slip_time) / 2,
                axle_time=stated(contact.axle_time) / 2,
                preload=2 * contact.preload_ratio,
            )
            title = "slip of MuJoCo's smoothed friction"
            return [Refinement("contact softness", title, {"contact": stiffer}, 2.0)]
        model_load = "across" if self._model.load == "instantaneous" else "static"
        title = "instantaneous wheel loads instead of the model's loads"
        changed = {"contact": replace(contact, load=model_load)}
        return [Refinement("loads that follow the motion", title, changed, 1.0)]

    def _wheel_refinements(self) -> list[Refinement]:
        if self._scenario.robot.skin is not None or self._twin.friction_law not in (
            "wheel",
            "axis",
        ):
            return []
        # A twin with preloaded contact needs axles with inertia, but a twin with loaded
        # contact does not.
        wheel_spin = 0.25
        factor = 4 / 3
        if self._twin.contact == "loaded":
            wheel_spin = 0.0
            factor = 1.0
        lighter = {"numerics": Numerics(wheel_spin=wheel_spin)}
        title = "inertia of the wheels about their axles"
        return [Refinement("wheel inertia", title, lighter, factor)]

    def _refinements(self) -> list[Refinement]:
        step = self._twin.timestep_s
        hinges = self._twin.hinges_per_segment
        arcs = {"numerics": Numerics(constant_curvature=True)}
        finer_hinges = arcs | {"hinges_per_segment": 2 * hinges}
        # The time integration is second-order accurate with loaded contact, and
        # first-order accurate with preloaded contact.
        order_factor = 4 / 3 if self._twin.contact == "loaded" else 2.0
        finer_model = {
            "timestep": self._model.timestep_s / 4,
            "slip_speed": self._model.slip_speed_m_s / 4,
        }
        lighter_links = {"numerics": Numerics(link_fraction=Numerics.link_fraction / 2)}
        spec = self._scenario.robot
        stiffer = _with_bending(
            spec,
            pitch_stiffness=4 * spec.bending.pitch_stiffness,
            roll_stiffness=4 * spec.bending.roll_stiffness,
        )
        title = "pitch and roll of segments"
        out_of_plane = Refinement(
            "out-of-plane motion", title, {"robot": stiffer}, 4 / 3
        )
        return [
            Refinement(
                "curvature not constant", "segments under load bend to an S", arcs, 1.0
            ),
            Refinement(
                "bending discretisation",
                f"{hinges} hinges per segment instead of an arc",
                finer_hinges,
                4 / 3,
                base=arcs,
            ),
            *self._wheel_refinements(),
            *self._contact_refinements(),
            out_of_plane,
            Refinement("link mass", "mass between the hinges", lighter_links, 2.0),
            Refinement(
                "twin time step",
                f"time step of {1e3 * step:g} ms",
                {"timestep": step / 2},
                order_factor,
            ),
            Refinement(
                "model time step",
                "time step and slip speed of the model",
                finer_model,
                4 / 3,
                plant="analytical",
            ),
        ]

    def analytical(self, on: frozenset[str], **options: object) -> Plant:
        """Build the analytical model with the switches named in `on` active."""
        spec = self._scenario.robot
        changes: dict[str, object] = {}
        for switch in self.all_switches:
            if switch.name in on:
                changes |= switch.options
        if "damping" not in on and self._model.model != "compliant":
            spec = _with_bending(spec, damping_time=spec.actuator.tau_mode)
        return self._scenario.build_plant("analytical", robot=spec, **changes | options)

    def twin(self, **options: Any) -> Plant:
        """Build the twin with changed arguments and without obstacles and objects."""
        free = replace(self._scenario.world, obstacles=(), polygons=(), objects=())
        return self._scenario.build_plant("twin", **{"world": free} | options)

    def damped_twins(self) -> dict[str, Callable[[], Plant]]:
        """Return builders of twins whose damping time is a bound of the 95 % interval.

        The dictionary is empty if the robot file states no interval, or if the chamber
        pressures depend on the bends. Closed chambers of this kind diverge if the
        damping time is short (docs/planar-models.md).
        """
        if self._scenario.document["pneumatics"]["kind"] != "lag":
            return {}
        file = RobotFile.model_validate(self._scenario.document["robot"])
        record = file.records().get("bending.damping_time_s")
        if record is None or record.uncertain is None:
            return {}
        bounds = file.bending.bounds["damping_time_s"]
        twins: dict[str, Callable[[], Plant]] = {}
        for end in record.uncertain.quantile(
            record.value, bounds, np.array([0.025, 0.975])
        ).tolist():
            robot = _with_bending(self._scenario.robot, damping_time=end)
            step = stable_step(self._twin.timestep_s, end)
            twins[f"damping of {1e3 * end:.2g} ms"] = partial(
                self.twin, robot=robot, timestep=step
            )
        return twins

    def stiff_twin(self) -> Plant:
        """Build the twin with stiff segments, for comparison with `matched`."""
        spec = self._scenario.robot
        stiffness = MATCHED_STIFFNESS_FACTOR * spec.bending.stiffness
        return self.twin(
            robot=_with_bending(
                spec, stiffness=stiffness, damping_time=spec.actuator.tau_mode
            )
        )

    def matched(self) -> Plant:
        """Build an analytical model with the friction, inertia and gaps of the twin."""
        on = {"friction law", "wheel track", "rigid gaps", "connector inertia"}
        # The bends of this model are prescribed, so it cannot have contacts.
        return self.analytical(
            frozenset(on), model="complete", friction_torque=True, contact=False
        )


def _with_bending(spec: RobotSpec, **changes: float) -> RobotSpec:
    return replace(spec, bending=replace(spec.bending, **changes))


Progress = Callable[[float, float | None], None]
"""Callback that receives the finished fraction (0 to 1) and the remaining time (s)."""

_MAX_STEPS = 12_000
"""Maximum number of twin time steps under a controller that reads the state.

The evaluation of such a controller at every tick takes several times as long as the
physics, and the attribution simulates the twin about eleven times.
"""
_TICK_ROUNDING = 1e-6
"""Tolerance for rounding a duration to whole ticks."""
_MIN_WINDOW_PERIODS = 4
"""Minimum number of gait periods if only the first part of a run is attributed."""

_TWIN_COST = 1.4
"""Mean computing time of a refined twin, relative to the original twin."""
_MODEL_COST = 2.5
"""Mean computing time of a model with active switches, relative to the original model.
"""


def explain(
    scenario: Scenario,
    trajectories: Mapping[str, Trajectory],
    *,
    progress: Progress | None = None,
    wall_s: Mapping[str, float] | None = None,
    whole: bool = False,
) -> Attribution:
    """Attribute the difference between the two plants of a run to assumptions.

    The analytical model is simulated with every subset of the switches. The differences
    between these variants and the twin determine the Shapley value of each switch. Then
    each approximation that only one plant makes is refined, and its effect is measured
    with all switches active. The contributions and an unexplained remainder add up to
    the difference between the plants.

    If the controller reads the state, only the first part of a long run is attributed
    (see `Attribution.window_s`). If the snake touches an obstacle, only the time before
    the first contact is attributed. All variants of the twin run without obstacles.

    Args:
        scenario: scenario of the run.
        trajectories: trajectory of each plant, keyed by plant name.
        progress: callback that receives the finished fraction (0 to 1) and the
            estimated remaining time (s).
        wall_s: computing time of each plant (s), keyed by plant name, for the estimate
            of the remaining time.
        whole: whether to attribute the whole duration of long runs.

    Raises:
        InputError: only one plant ran, the runs are too short for gait metrics, or the
            scenario sets `comparison.gap_factor`.
        DivergedError: a variant of a plant diverged.
    """
    if not {"analytical", "twin"} <= trajectories.keys():
        raise InputError(
            "an attribution compares the two plants, but only one of them was run; run"
            " both `analytical` and `twin`"
        )
    controller = scenario.build_controller()
    end = max(float(run.time[-1]) for run in trajectories.values())
    window = None if whole else _window(scenario, controller, end)
    limit = contact_free_s(trajectories.values())
    if window is not None:
        limit = min(limit, window)
    model = trajectories["analytical"].between(0.0, limit)
    twin = trajectories["twin"].between(0.0, limit)
    gap = _checked_gap(scenario, model, twin)
    variants = PlantVariants(scenario)
    fraction = 1.0 if window is None else window / scenario.duration
    walls = {kind: fraction * wall for kind, wall in (wall_s or {}).items()}
    runs = _run_all(scenario, variants, controller, window, progress, walls)
    runs = {name: run.between(0.0, limit) for name, run in runs.items()}
    runs |= {_variant_name(frozenset()): model, _variant_name({}): twin}
    shares = _shares(variants, runs, gap)
    remainder = gap - np.sum([share.value for share in shares], axis=0)
    metrics = plant_metrics(model)
    return Attribution(
        reference=tuple(float(metrics.get(name) or 0.0) for name in MEASURES),
        gap=_to_floats(gap),
        shares=tuple(shares),
        remainder=_to_floats(remainder),
        matched=_to_floats(gap_between(runs["matched"], runs["stiff twin"])),
        damping={
            name: _to_floats(gap_between(model, runs[name]) - gap)
            for name in variants.damped_twins()
        },
        same=tuple(variants.same),
        window_s=None if math.isinf(limit) else limit,
    )


def _checked_gap(scenario: Scenario, model: Trajectory, twin: Trajectory) -> np.ndarray:
    try:
        gap = gap_between(model, twin)
    except ValueError as error:
        raise InputError(
            f"{scenario.name}: {error}; at least three gait periods are needed"
        ) from error
    if scenario.file.comparison.gap_factor:
        raise InputError(
            f"{scenario.name}: the difference cannot be attributed, because"
            " `comparison.gap_factor` scales the speed; remove"
            " `comparison.gap_factor` (the attribution covers rigid gaps without it)"
        )
    return gap


def _window(scenario: Scenario, controller: Controller, end: float) -> float | None:
    if _is_script(controller) or controller.frequency is None:
        return None
    twin = scenario.file.plants.twin or TwinFile()
    tick = scenario.build_plant("twin").tick
    longest = max(
        _MAX_STEPS * twin.timestep_s, _MIN_WINDOW_PERIODS / controller.frequency
    )
    window = round(math.ceil(longest / tick - _TICK_ROUNDING) * tick, 9)
    return window if window < end else None


def _is_script(controller: Controller) -> bool:
    return type(controller).script is not Controller.script


def main_cause(
    scenario: Scenario, trajectories: Mapping[str, Trajectory]
) -> MainCause | None:
    """Return the effect of compliant bends, which is usually the largest contribution.

    Returns:
        Dictionary with the name of the assumption (`name`) and its effects on
        `com_speed_m_s` and `yaw_rate_rad_s`. If the snake touches an obstacle, the
        effects cover only the time before the first contact, which is added as
        `window_s`. The result is None for runs without a gait, runs with a planner,
        compliant models and spatial robots.
    """
    if scenario.robot.is_spatial:
        return None
    end = contact_free_s(trajectories.values())
    variants = PlantVariants(scenario)
    model = plant_metrics(trajectories["analytical"].between(0.0, end))
    differs = "compliance" in [switch.name for switch in variants.switches]
    if not differs or scenario.planner is not None or model["com_speed_m_s"] is None:
        return None
    on = variants.first_on | {"compliance"}
    run = rollout(
        variants.analytical(on), scenario.build_controller(), **scenario.timing
    )
    compliant = plant_metrics(run.between(0.0, end))
    cause: MainCause = {
        "name": "compliance",
        "com_speed_m_s": compliant["com_speed_m_s"] - model["com_speed_m_s"],
        "yaw_rate_rad_s": compliant["yaw_rate_rad_s"] - model["yaw_rate_rad_s"],
    }
    if not math.isinf(end):
        cause["window_s"] = end
    return cause


def _builders(variants: PlantVariants) -> dict[str, Callable[[], Plant]]:
    builders: dict[str, Callable[[], Plant]] = {
        "stiff twin": variants.stiff_twin,
        "matched": variants.matched,
    }
    for switched in filter(None, variants.sets):
        builders[_variant_name(switched)] = partial(variants.analytical, switched)
    for refinement in variants.refinements:
        if refinement.plant == "analytical":
            builders[refinement.name] = partial(
                variants.analytical, variants.sets[-1], **refinement.options
            )
            continue
        builders[refinement.name] = partial(variants.twin, **refinement.options)
        if refinement.base:
            builders.setdefault(
                _variant_name(refinement.base),
                partial(variants.twin, **refinement.base),
            )
    return builders | variants.damped_twins()


def _variant_name(changes: frozenset[str] | Mapping[str, object]) -> str:
    if isinstance(changes, frozenset):
        return f"model with {', '.join(sorted(changes))}"
    return f"twin with {', '.join(sorted(map(str, changes.items())))}"


def _run_all(
    scenario: Scenario,
    variants: PlantVariants,
    controller: Controller,
    window: float | None,
    progress: Progress | None,
    wall_s: Mapping[str, float],
) -> dict[str, Trajectory]:
    builders = _builders(variants)
    costs = [_relative_cost(name, wall_s) for name in builders]
    report = None
    if progress is not None:
        report = _reporter(progress, costs, is_measured=bool(wall_s))
    results: Iterable[Trajectory | DivergedError]
    if not _is_script(controller):
        # A controller that reads the state holds the interpreter lock, so the variants
        # run in processes instead of threads. Each process receives a controller that
        # already contains the plan.
        duration = window or scenario.duration
        tasks = [_Task(scenario, name, controller, duration) for name in builders]
        results = _in_processes(tasks, report)
    else:
        jobs = [
            Job(build, scenario.build_controller, **scenario.timing)
            for build in builders.values()
        ]
        results = run_many(jobs, progress=report)
    trajectories: dict[str, Trajectory] = {}
    for name, run in zip(builders, results, strict=True):
        if isinstance(run, DivergedError):
            run.args = (f"{scenario.name}: attribution: {name}: {run}",)
            raise run
        trajectories[name] = run
    return trajectories


class _Task(NamedTuple):
    scenario: Scenario
    variant: str
    controller: Controller
    duration: float


def _in_processes(
    tasks: Sequence[_Task], report: Callable[[int], None] | None
) -> list[Trajectory | DivergedError]:
    results: dict[int, Any] = {}
    with closing(run_tasks(_simulate, tasks)) as completed:
        for done in completed:
            if done.error is not None and not isinstance(done.error, DivergedError):
                raise done.error
            results[done.number] = done.error or done.result
            if report is not None:
                report(len(results))
    return [results[number] for number in range(len(tasks))]


def _simulate(task: _Task) -> Trajectory:
    plant = _builders(PlantVariants(task.scenario))[task.variant]()
    timing = task.scenario.timing | {"duration": task.duration}
    return rollout(plant, task.controller, **timing)


def _relative_cost(name: str, wall_s: Mapping[str, float]) -> float:
    if name == "matched" or name.startswith("model "):
        return _MODEL_COST * wall_s.get("analytical", 0.05)
    return _TWIN_COST * wall_s.get("twin", 1.0)


def _reporter(
    progress: Progress, costs: Sequence[float], *, is_measured: bool
) -> Callable[[int], None]:
    start = time.monotonic()
    total = sum(costs)
    remaining = None
    if is_measured:
        remaining = total / min(processor_count(), len(costs))
    progress(0.0, remaining)

    def report(done: int) -> None:
        fraction = sum(costs[:done]) / total if done < len(costs) else 1.0
        progress(fraction, (time.monotonic() - start) * (1 / fraction - 1))

    return report


def _shares(
    variants: PlantVariants,
    runs: Mapping[str, Trajectory],
    gap: np.ndarray,
) -> list[AssumptionShare]:
    twin = runs[_variant_name({})]
    names = [switch.name for switch in variants.switches]
    differences = {
        subset: gap_between(runs[_variant_name(variants.first_on | subset)], twin)
        for subset in subsets(names)
    }
    change = differences[frozenset()] - gap
    frozen = Contribution(change, change, change)
    averaged = contributions(names, differences)
    return [
        *(_make_share(switch, "first", frozen) for switch in variants.first),
        *(
            _make_share(switch, "averaged", averaged[switch.name])
            for switch in variants.switches
        ),
        *_refinement_shares(variants, runs),
    ]


def _refinement_shares(
    variants: PlantVariants, runs: Mapping[str, Trajectory]
) -> list[AssumptionShare]:
    model = runs[_variant_name(variants.sets[-1])]
    twin = runs[_variant_name({})]
    shares = []
    for refinement in variants.refinements:
        if refinement.plant == "twin":
            before = gap_between(model, runs[_variant_name(refinement.base)])
            after = gap_between(model, runs[refinement.name])
        else:
            before = gap_between(model, twin)
            after = gap_between(runs[refinement.name], twin)
        value = refinement.factor * (after - before)
        shares.append(
            _make_share(refinement, "refined", Contribution(value, value, value))
        )
    return shares


def _make_share(
    assumption: Switch | Refinement, how: str, contribution: Contribution
) -> AssumptionShare:
    """Return a share, which is positive if the assumption explains the difference."""
    value, low, high = (
        _to_floats(-bound)
        for bound in (contribution.value, contribution.high, contribution.low)
    )
    return AssumptionShare(assumption.name, assumption.title, value, low, high, how)


def _to_floats(values: Sequence[float] | np.ndarray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


__all__ = ["explain", "main_cause"]
