"""Locomotion: what is left to find when friction and actuators are known, from runs of the crawling robot.

Either plant is driven as the robot was and held against what was measured: by period-averaged speed and yaw
rate (`averages`), by path, heading and bends over time (`shapes`), or by both. Of the masses only their
ratios act, and stiffness and damping only over them; with bends as given (`complete`) stiffness does not
act at all. The verdicts say so, whatever is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from srs_twin.comparison.metrics import plant_metrics
from srs_twin.control.base import Controller
from srs_twin.errors import DivergedError, InputError, UnknownNameError
from srs_twin.identification.estimate import Estimate, Parameter, Residual, Role
from srs_twin.identification.fit_file import DataSet, trajectory_hash, with_roles
from srs_twin.identification.least_squares import Search, SearchOptions, Watch, least_squares
from srs_twin.identification.unknowns import unknowns, with_values
from srs_twin.plants.base import Plant
from srs_twin.pneumatics import Pneumatics
from srs_twin.recordings.body.trajectories import numbered_columns
from srs_twin.robot.spec import RobotSpec
from srs_twin.rollout import rollout
from srs_twin.trajectory import Trajectory

PLANTS = ("analytical", "twin")
AGAINST = ("averages", "shapes", "both")

# What a measured value may be off by, and units; a bend by what markers leave of it, if that is more.
NOISE = {
    "speed": (2e-3, "m/s"),
    "yaw_rate": (1e-2, "rad/s"),
    "path": (2e-3, "m"),
    "heading": (2e-2, "rad"),
    "bend": (2e-2, "rad"),
}
_STEPS = (3e-2, 0.1)
"""Of differences, in z, fine and coarse: the analytical plants have kinks."""

MOST_TWIN_RUNS = 150
"""How often a search runs the twin through all recordings at most."""

_CLOSE_STEPS = {"tolerance": 2e-5}  # m/s
"""Settings with which an analytical plant is fitted: friction is resolved ten times as closely as by default.
With the default, differences between runs are those of the step control."""

_COMPLIANT_STEPS = _CLOSE_STEPS | {"timestep": 0.0005, "slip_speed": 0.001}  # s, m/s
"""The same for `compliant`, whose steps have a fixed length. With the default (2 ms, 0.25 mm/s) the sum of
squares has many minima a few standard errors apart, and derivatives contain this ripple. The slip speed is
that of the twin."""

_DIVERGED = 1e3
_RATE = 50.0  # Hz: at which shapes are compared at most


@dataclass(frozen=True)
class GaitRun:
    """One measured run of the crawling robot.

    Attributes:
        trajectory: what was measured, from rest, with the gait's frequency in its metadata.
        controller: what commanded the valves.
        supply_pa: Pa, gauge.
        name: of the data.
        chambers: of the plant of a robot, where pressures were recorded instead of valves; None: its own.
    """

    trajectory: Trajectory
    controller: Controller
    supply_pa: float
    name: str
    chambers: Callable[[RobotSpec], Pneumatics] | None = None

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""
        return DataSet(self.name, trajectory_hash(self.trajectory), role, len(self.trajectory))


@dataclass(frozen=True)
class PlantModel:
    """Which plant stands for the robot.

    Attributes:
        plant: "analytical" or "twin".
        settings: as the plant takes them, such as model="compliant", friction="wheel"; they replace the
            finer steps of fits against the analytical plant.
    """

    plant: str = "analytical"
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.plant not in PLANTS:
            raise UnknownNameError("plant", self.plant, PLANTS)

    def search_options(self, against: str) -> SearchOptions:
        """Return how a search suits the plant.

        The twin's motion is smooth to 1e-3 in z. But its path and heading follow the unknowns only up to
        1e-2, and farther off they say nothing; its bends follow them up to 1, so they lead the search. What
        data tell is judged over the few per cent that they leave open. `compliant` has kinks as the twin has,
        finer ones, but all of its signals follow the unknowns.
        """
        if self.plant == "twin":
            guide = None if against == "averages" else lambda each: " bend_" in each.name
            return SearchOptions(3e-3, 3e-2, 3e-4, guide, telling=3e-2, enough=1e-2, most_runs=MOST_TWIN_RUNS)
        if self.settings.get("model") == "compliant":
            return SearchOptions(1e-2, 3e-2, 1e-4, lambda each: True, telling=1e-2)
        return SearchOptions(*_STEPS)

    def build(self, spec: RobotSpec, supply_pa: float, chambers: Pneumatics | None = None) -> Plant:
        """Return the plant of a robot, with chambers of its own or given ones."""
        settings = self.settings if chambers is None else {**self.settings, "pneumatics": chambers}
        if self.plant == "twin":
            from srs_twin.plants.twin.snake import TwinSnake

            return TwinSnake(spec, supply_pa=supply_pa, **settings)
        from srs_twin.plants.analytical import AnalyticalSnake

        steps = _COMPLIANT_STEPS if settings.get("model") == "compliant" else _CLOSE_STEPS
        return AnalyticalSnake(spec, supply_pa=supply_pa, **{**steps, **settings})

    def follow(self, run: GaitRun, spec: RobotSpec) -> Trajectory:
        """Return what the plant does when it is driven as the robot was.

        Raises:
            DivergedError: it diverges.
        """
        plant = self.build(spec, run.supply_pa, run.chambers(spec) if run.chambers else None)
        span = float(run.trajectory.time[-1] - run.trajectory.time[0])
        duration = math.ceil(span / plant.tick - 1e-9) * plant.tick
        return rollout(plant, run.controller, duration, record_hz=1 / plant.tick)


_Data = tuple[GaitRun, dict[str, np.ndarray], Role]
"""A run, its signals and its role."""


def fit_locomotion(
    runs: Sequence[GaitRun],
    spec: RobotSpec,
    names: Iterable[str],
    *,
    model: PlantModel | None = None,
    against: str = "averages",
    validation: Sequence[GaitRun] = (),
    starts: int = 3,
    watch: Watch | None = None,
    reference: PlantModel | None = None,
    known: Sequence[Parameter] = (),
) -> Estimate:
    """Return what gait runs tell of a robot.

    Args:
        runs: what was measured.
        spec: the robot that the search starts from; what is not asked for is held at its values.
        names: what is unknown, see `unknowns`.
        model: the plant that stands for the robot; default the analytical one.
        against: "averages", "shapes" or "both".
        validation: runs to hold the estimate against.
        starts: how many searches; one may end in a minimum that is not the least, with a large residual.
            Against the twin one does, where shapes lead it.
        watch: is told how far the search is, see `least_squares`.
        reference: a plant that is nearer to the robot than the model; shows by how much the model's own error
            moves the estimate, see `least_squares`. None: intervals suppose that the model is right.
        known: parameters that were measured; they are held there, and not fitted.

    Raises:
        InputError: no run, too few for so many unknowns, a run without a whole gait period, or one to
            validate with that is also fitted.
    """
    if against not in AGAINST:
        raise UnknownNameError("residual", against, AGAINST)
    model = model or PlantModel()
    spec = with_values(spec, {each.name: each.value for each in known if each.value is not None})
    looked_for = unknowns(spec, [name for name in names if all(name != each.name for each in known)])
    everything = [
        (run, signals(run.trajectory, None, against, run.name), role)
        for run, role in with_roles("gait runs", runs, validation)
    ]

    def residuals(data: Sequence[_Data], values: Mapping[str, float]) -> list[Residual]:
        robot = with_values(spec, values)
        found: list[Residual] = []
        for run, seen, role in data:
            try:
                predicted = signals(model.follow(run, robot), run.trajectory, against, run.name)
                off = {name: seen[name] - predicted[name] for name in seen}
            except DivergedError:
                off = {name: np.full_like(each, _DIVERGED) for name, each in seen.items()}
            for name, each in off.items():
                scale, unit = NOISE[name if name in NOISE else name.rpartition("_")[0]]
                stated = run.trajectory.columns.get(name.replace("bend", "bend_error"))
                if "bend" in name and stated is not None:
                    scale = max(scale, float(np.sqrt(np.mean(stated**2))))
                found.append(Residual(f"{run.name} {name}", unit, each, scale, role))
        return found

    options = model.search_options(against)
    fitted = [each for each in everything if each[2] == "fit"]
    kept = partial(residuals, [each for each in everything if each[2] != "fit"])

    def refit(values: Mapping[str, float]) -> dict[str, float]:
        assert reference is not None
        robot, made = with_values(spec, values), []  # the search starts where that of the data did
        for run, _, role in fitted:
            moved = replace(run, trajectory=reference.follow(run, robot))
            made.append((moved, signals(moved.trajectory, None, against, run.name), role))
        search = Search(partial(residuals, made), looked_for, options, None)
        return search.values(search.run(np.array([each.coordinate(each.start) for each in looked_for])).z)

    if not looked_for and known:
        return Estimate((), np.zeros((0, 0)), (*residuals(fitted, {}), *kept({}))).with_known(known)
    found = least_squares(
        partial(residuals, fitted),
        looked_for,
        options=options,
        starts=starts,
        watch=watch,
        validation=kept,
        refit=None if reference is None else refit,
    )
    return found.with_known(known)


def signals(
    trajectory: Trajectory, like: Trajectory | None, against: str, name: str
) -> dict[str, np.ndarray]:
    """Return what runs are compared by, name → shape (samples,).

    Args:
        trajectory: a run.
        like: a measured run on whose times and place to put it; None: its own.
        against: one of `AGAINST`.
        name: of the run, for messages.

    Raises:
        InputError: averages are wanted of a run that has no whole gait period.
    """
    found: dict[str, np.ndarray] = {}
    if against != "shapes":
        metrics = plant_metrics(trajectory)
        if metrics["com_speed_m_s"] is None:
            wanted = "three whole periods and gait_frequency_hz in the metadata are wanted"
            raise InputError(f"{name}: no average over gait periods; {wanted}")
        found["speed"] = np.array([metrics["com_speed_m_s"]])
        found["yaw_rate"] = np.array([metrics["yaw_rate_rad_s"]])
    if against != "averages":
        found |= _shapes(trajectory, like or trajectory, moved=like is not None)
    return found


def _shapes(trajectory: Trajectory, like: Trajectory, *, moved: bool) -> dict[str, np.ndarray]:
    """Return path, heading and bends at some of the times of another run, laid upon it as well as can be."""
    span = like.time[-1] - like.time[0]
    count = min(len(like), int(span * _RATE) + 1)
    clock = np.linspace(0.0, span, count)

    def at(run: Trajectory, values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(run), -1).T
        return np.stack([np.interp(clock, run.time - run.time[0], each) for each in flat], axis=1)

    path, heading = at(trajectory, trajectory.com), at(trajectory, trajectory["heading"])[:, 0]
    if moved:
        other, aim = at(like, like.com), at(like, like["heading"])[:, 0]
        turn = float((aim - heading).mean())
        c, s = math.cos(turn), math.sin(turn)
        path = (path - path.mean(axis=0)) @ np.array([[c, s], [-s, c]]) + other.mean(axis=0)
        heading = heading + turn
    found = {"path_x": path[:, 0], "path_y": path[:, 1], "heading": heading}
    return found | numbered_columns("bend", at(trajectory, trajectory.stack("bend")))
