r"""Why twin and analytical model differ: assumptions switched one at a time, and each one's share.

On the analytical side a switch turns an assumption of the model into what the twin has; any subset of them is
a model. With v(S) the gap to the twin when the switches S are on, switch i contributes on average over all n!
orders of switching (Shapley's value)

$$ \phi_i = \sum_{S \not\ni i} \frac{|S|!\,(n - |S| - 1)!}{n!}\,\bigl[v(S \cup i) - v(S)\bigr], $$

and the contributions add up to v(all) − v(none). What the twin alone has is refined: by how much it is made
smaller and how its effect then shrinks give what it contributes in all.
"""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from srs_twin.comparison.compare import MEASURES, AssumptionShare, Attribution, gap_between
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.errors import DivergedError, InputError
from srs_twin.plants.base import Plant
from srs_twin.plants.twin.mjcf.numerics import LAW_OF, Numerics, PreloadedContact
from srs_twin.robot.spec import RobotSpec
from srs_twin.rollout import Job, rollout, run_many
from srs_twin.scenario.plants import AnalyticalFile, TwinFile
from srs_twin.scenario.scenario import Scenario
from srs_twin.trajectory import Trajectory


@dataclass(frozen=True)
class Contribution:
    """What one switch contributes: its average over all orders, the least and the most of it."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


def subsets(names: Sequence[str]) -> list[frozenset[str]]:
    """Return all subsets, small ones first."""
    return [frozenset(some) for size in range(len(names) + 1) for some in combinations(names, size)]


def contributions(names: Sequence[str], seen: Mapping[frozenset[str], np.ndarray]) -> dict[str, Contribution]:
    """Return what each switch contributes.

    Args:
        names: the switches.
        seen: what is seen with each subset of them on; arrays of one shape.
    """
    n = len(names)
    found = {}
    for name in names:
        others = [each for each in names if each != name]
        steps = [(len(some), seen[some | {name}] - seen[some]) for some in subsets(others)]
        weights = [
            math.factorial(size) * math.factorial(n - size - 1) / math.factorial(n) for size, _ in steps
        ]
        value = np.sum([w * step for w, (_, step) in zip(weights, steps, strict=True)], axis=0)
        every = [step for _, step in steps]
        found[name] = Contribution(value, np.min(every, axis=0), np.max(every, axis=0))
    return found


FROZEN = "frozen chords"
STIFF = 45.0
"""How many times stiffer the bends of the matched setting are: gen 2's 0.44 become 20 N·m/rad."""

Change = Callable[[RobotSpec], RobotSpec]


class Switch(NamedTuple):
    """An assumption of the analytical model that the twin does not make.

    Attributes:
        name: short name.
        title: what it is, from → to.
        differs: whether the twin of this scenario has it otherwise.
        options: arguments of the analytical model that switch it; later switches' go before earlier ones'.
    """

    name: str
    title: str
    differs: bool
    options: dict[str, Any]


@dataclass(frozen=True)
class Refinement:
    """Something that one plant alone has, made smaller.

    Attributes:
        name: short name.
        title: what it is, and how it was made smaller.
        options: changed arguments of the plant.
        factor: all of its effect over the part that the refinement took away.
        plant: "twin" or "analytical".
        base: changed arguments of the plant that it is compared with.
        change: of the robot.
    """

    name: str
    title: str
    options: dict[str, Any]
    factor: float
    plant: str = "twin"
    base: dict[str, Any] = field(default_factory=dict)
    change: Change = lambda spec: spec


class Ladder:
    """The plants of a scenario with any of their assumptions switched.

    Attributes:
        first: what is switched before all others: arcs come before they can yield.
        switches: those of the analytical side that differ here and go in any order.
        same: names of those that do not.
        refinements: of what one plant alone has.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._model = scenario.file.plants.analytical or AnalyticalFile()
        self._twin = scenario.file.plants.twin or TwinFile()
        self._every = self._all_switches()
        self.first = [each for each in self._every if each.differs and each.name == FROZEN]
        self.switches = [each for each in self._every if each.differs and each.name != FROZEN]
        self.same = [each.name for each in self._every if not each.differs]
        self.refinements = self._refinements()

    def _all_switches(self) -> list[Switch]:
        model, twin, spec = self._model, self._twin, self._scenario.robot
        law, lag = self._twin.law, spec.bending.damping_time
        point = model.friction not in LAW_OF.values()
        springs = model.model != "compliant"
        damped = springs and lag != spec.actuator.tau_mode
        friction, gaps = f"friction law: {model.friction} → {law}", f"rigid gaps: {model.gaps} → {twin.gaps}"
        track = "contacts: one point a connector → two at the track"
        frozen = "chords frozen, and friction torque where it is left out → arcs"
        bends = "bends: as given → springs that load and inertia deflect"
        inertia = f"inertia of a connector about itself: {model.inertia} → compact"
        half, torque = spec.geometry.half_track, {"friction_torque": True}
        by_law = {"friction": law, "track": 0.0 if point else half}
        return [
            Switch("friction law", friction, model.friction != law, by_law),
            Switch("wheel track", track, point, {"track": half}),
            Switch("rigid gaps", gaps, model.gaps != twin.gaps, {"gaps": twin.gaps}),
            Switch(FROZEN, frozen, model.model == "simplified", torque | {"model": "complete"}),
            Switch("compliance", bends, springs, torque | {"model": "compliant"}),
            Switch("damping", f"damping c/k: τ₂ → {1e3 * lag:g} ms", damped, {}),
            Switch("connector inertia", inertia, model.inertia != "connector", {"inertia": "connector"}),
        ]

    def _contact_refinements(self) -> list[Refinement]:
        """Return those of how the floor holds the twin."""
        contact = self._twin.build_contact()
        if isinstance(contact, PreloadedContact):
            stiffer = replace(
                contact,
                slip_time=contact.slip_time / 2,
                axle_time=contact.axle_time / 2,
                preload=2 * contact.pressed,
            )
            title = "slip of MuJoCo's smoothed friction"
            return [Refinement("contact softness", title, {"contact": stiffer}, 2.0)]
        models = "across" if self._model.load == "momentary" else "static"
        shared = {"contact": replace(contact, load=models)}
        loads = Refinement(
            "loads that follow the motion",
            "friction on what presses a wheel, not on the model's loads",
            shared,
            1.0,
        )
        bodies = {law: wheels for wheels, law in LAW_OF.items()}
        if contact.law not in bodies or self._scenario.world.uneven:
            return [loads]
        static = {"contact": replace(contact, load="static")}
        pressed = {"contact": PreloadedContact(bodies[contact.law])}
        solver = Refinement(
            "friction solver", "the law that sticks → MuJoCo's own friction", pressed, 1.0, base=static
        )
        return [loads, solver]

    def _refinements(self) -> list[Refinement]:
        step, hinges = self._twin.timestep_s, self._twin.hinges_per_segment
        arcs = {"numerics": Numerics(constant_curvature=True)}
        model = {"timestep": self._model.timestep_s / 4, "slip_speed": self._model.slip_speed_m_s / 4}
        finer = arcs | {"hinges_per_segment": 2 * hinges}
        lighter = {"numerics": Numerics(link_share=Numerics.link_share / 2)}
        # Axles need inertia, and the preloaded twin is of first order in its step; the loaded one is neither.
        loaded = self._twin.contact == "loaded"
        left, most = (0.0, 1.0) if loaded else (0.25, 4 / 3)
        spin = Refinement(
            "wheel inertia",
            "wheels' inertia about their axles",
            {"numerics": Numerics(wheel_spin=left)},
            most,
        )
        rigid = Refinement("out-of-plane motion", "segments that pitch and roll", {}, 4 / 3)
        hinged = f"{hinges} hinges a segment for an arc"
        model_step = "the model's time step and slip speed"
        return [
            Refinement("curvature not constant", "segments under load bend to an S", arcs, 1.0),
            Refinement("bending discretisation", hinged, finer, 4 / 3, base=arcs),
            *([spin] if self._twin.law != "ellipse" else []),
            *self._contact_refinements(),
            replace(rigid, change=_stiffer_out_of_plane),
            Refinement("link mass", "mass between the hinges", lighter, 2.0),
            Refinement(
                "twin time step", f"its {1e3 * step:g} ms", {"timestep": step / 2}, 4 / 3 if loaded else 2.0
            ),
            Refinement("model time step", model_step, model, 4 / 3, plant="analytical"),
        ]

    def analytical(self, on: frozenset[str], **options: Any) -> Plant:
        """Return the analytical model with these switches on.

        Args:
            on: names of switches.
            options: further changes.
        """
        spec = self._scenario.robot
        changes = dict(ChainMap(*(each.options for each in reversed(self._every) if each.name in on)))
        if "damping" not in on and self._model.model != "compliant":
            spec = replace(spec, bending=replace(spec.bending, damping_time=spec.actuator.tau_mode))
        return self._scenario.build_plant("analytical", robot=spec, **changes | options)

    def twin(self, change: Change = lambda spec: spec, **options: Any) -> Plant:
        """Return the twin with these changes of the robot and of its own arguments."""
        return self._scenario.build_plant("twin", robot=change(self._scenario.robot), **options)

    def stiff_twin(self) -> Plant:
        """Return the twin with the stiff bends of the match."""

        def stiffer(spec: RobotSpec) -> RobotSpec:
            stiffness, lag = STIFF * spec.bending.stiffness, spec.actuator.tau_mode
            return replace(spec, bending=replace(spec.bending, stiffness=stiffness, damping_time=lag))

        return self.twin(stiffer)

    def matched(self) -> Plant:
        """Return the analytical model with the twin's friction, inertia and gaps, and its bends as given."""
        on = {"friction law", "wheel track", "rigid gaps", "connector inertia"}
        return self.analytical(frozenset(on), model="complete", friction_torque=True)


def _stiffer_out_of_plane(spec: RobotSpec) -> RobotSpec:
    bending = spec.bending
    stiffer = replace(
        bending, pitch_stiffness=4 * bending.pitch_stiffness, roll_stiffness=4 * bending.roll_stiffness
    )
    return replace(spec, bending=stiffer)


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
    if scenario.file.comparison.gap_factor:
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
    change = seen[first] - gap
    alone = Contribution(change, change, change)
    shares = [_share(switch.name, switch.title, "first", alone) for switch in ladder.first]
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


def main_cause(scenario: Scenario, trajectories: Mapping[str, Trajectory]) -> dict[str, Any] | None:
    """Return what compliance alone changes of the analytical model, which one more run of it tells.

    It usually is the largest of the shares that `explain` finds.

    Args:
        scenario: what ran.
        trajectories: what both plants did, by name.

    Returns:
        The assumption's `name` and by how much it changes `com_speed_m_s` and `yaw_rate_rad_s`; None where
        the model has no gait, or is compliant already.
    """
    ladder, model = Ladder(scenario), plant_metrics(trajectories["analytical"])
    known = "compliance" in [switch.name for switch in ladder.switches]
    if not known or scenario.planner is not None or model["com_speed_m_s"] is None:
        return None
    on = frozenset(switch.name for switch in ladder.first) | {"compliance"}
    run = rollout(ladder.analytical(on), scenario.build_controller(), **scenario.timing)
    found = plant_metrics(run)
    changes = {name: found[name] - model[name] for name in ("com_speed_m_s", "yaw_rate_rad_s")}
    return {"name": "compliance", **changes}


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
    names = switched if isinstance(switched, frozenset) else map(str, switched.items())
    return f"{plant} with {', '.join(sorted(names))}"


def _run_all(
    scenario: Scenario, plants: Mapping[str, Callable[[], Plant]], progress: Progress | None
) -> dict[str, Trajectory]:
    """Roll every plant out under the scenario's gait, on all processors."""
    jobs = [Job(build, scenario.build_controller, **scenario.timing) for build in plants.values()]
    report = None if progress is None else lambda done: progress(done / len(jobs))
    found: dict[str, Trajectory] = {}
    for name, run in zip(plants, run_many(jobs, progress=report), strict=True):
        if isinstance(run, DivergedError):
            run.args = (f"{scenario.name}: why they differ: {name}: {run}",)
            raise run
        found[name] = run
    return found


def _share(name: str, title: str, how: str, found: Contribution) -> AssumptionShare:
    """Return a share; what a switch takes off the gap is its share of it."""
    return AssumptionShare(
        name, title, _numbers(-found.value), _numbers(-found.high), _numbers(-found.low), how
    )


def _numbers(values: Sequence[float] | np.ndarray) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


__all__ = ["explain", "main_cause"]
