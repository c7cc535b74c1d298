r"""Friction from coasting: the robot is thrown across the floor, straight, with vented chambers.

Along its wheels it loses μ_t g/(1 + s), across them μ_n g; thrown at an angle, what the friction law says
(`plants.sliding`, which also tells what s is). Where each run began and how fast it was thrown is found along
with μ_t and μ_n; a direction in which it went no further than noise is taken as not thrown at all.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.friction import LAWS
from srs_twin.identification.data_set import DataSet, data_sets, keep_apart, trajectory_hash
from srs_twin.identification.estimate import Estimate, Residual, Role
from srs_twin.identification.least_squares import least_squares
from srs_twin.identification.search import Watch
from srs_twin.identification.unknowns import Unknown, unknowns
from srs_twin.identification.velocity import moving_slope
from srs_twin.plants.sliding import slide, spin_share
from srs_twin.spec import RobotSpec
from srs_twin.trajectory import Trajectory

_NAMES = ("friction.mu_t", "friction.mu_n")
_MOST_TURN = 0.2  # rad: beyond it the body is no longer a point
_LEAST_SAMPLES = 8
_LEAST_SPEED = 0.02  # m/s
_NOISE = 1e-3  # m
_SEEN = 3.0  # times the noise: what it must go in a direction to have been thrown that way
_WAYS = ("along", "across")


@dataclass(frozen=True)
class Coasting:
    """One throw.

    Attributes:
        name: of the data.
        sha256: of them.
        time: from the first sample used, shape (samples,), s.
        place: centre of mass along and across the mean heading, from the first sample, (samples, 2), m.
        velocity: a first guess of how it was thrown, along and across, m/s.
        span: begin and end of what was used, s on the recording's clock.
    """

    name: str
    sha256: str
    time: np.ndarray
    place: np.ndarray
    velocity: tuple[float, float]
    span: tuple[float, float]

    @classmethod
    def of(cls, trajectory: Trajectory, name: str, *, start: float | None = None) -> Coasting:
        """Return the throw that a trajectory shows.

        Args:
            trajectory: a recording, or a plant's.
            name: what to call it.
            start: from when on nobody touches the robot, s; None: from where it is fastest.

        Raises:
            InputError: too short, too slow, or the robot turns.
        """
        time, com = trajectory.time, trajectory.com
        if len(time) < _LEAST_SAMPLES:
            raise InputError(f"{name}: {len(time)} samples; {_LEAST_SAMPLES} or more are wanted")
        speed = np.hypot(*moving_slope(time, com).T)
        first = int(np.argmax(speed)) if start is None else int(np.searchsorted(time, start))
        time, com = time[first:], com[first:]
        if len(time) < _LEAST_SAMPLES:
            raise InputError(
                f"{name}: {len(time)} samples after the throw; {_LEAST_SAMPLES} or more are wanted"
            )
        if speed[first] < _LEAST_SPEED:
            raise InputError(
                f"{name}: it moves at {speed[first]:.2g} m/s at most; a throw of "
                f"{_LEAST_SPEED:g} m/s or more is wanted"
            )
        heading = trajectory["heading"][first:]
        if np.ptp(heading) > _MOST_TURN:
            raise InputError(
                f"{name}: it turns by {np.ptp(heading):.2g} rad while it coasts; {_MOST_TURN:g} rad at most: "
                "throw it straight along or across"
            )
        c, s = np.cos(heading.mean()), np.sin(heading.mean())
        place = (com - com[0]) @ np.array([[c, -s], [s, c]])
        guess = moving_slope(time, place)[0]
        return cls(
            name, trajectory_hash(trajectory), time - time[0], place, (float(guess[0]), float(guess[1])),
            (float(time[0]), float(time[-1])),
        )  # fmt: skip

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""
        return DataSet(self.name, self.sha256, role, 2 * len(self.time), *self.span)


def fit_coasting(
    runs: Sequence[Coasting],
    spec: RobotSpec,
    *,
    validation: Sequence[Coasting] = (),
    law: str = "wheel",
    wheel_inertia: bool = True,
    noise: float = _NOISE,
    watch: Watch | None = None,
) -> Estimate:
    """Return μ_t and μ_n from throws.

    Args:
        runs: throws; along them and across them, to know both.
        spec: the robot, whose wheels and masses say how much the wheels' spinning adds.
        validation: throws to hold the estimate against; of these only the throw itself is fitted.
        law: "axis", "wheel" or "ellipse".
        wheel_inertia: whether wheels have to stop spinning, as the robot's and the twin's; the analytical
            plant's and skids have none.
        noise: of a measured place, m.
        watch: is told how far the search is, see `least_squares`.

    Raises:
        InputError: no run, an unknown law, or a run to validate with that is also fitted.
    """
    if law not in LAWS or law == "viscous":
        raise InputError(f"friction law '{law}' is unknown here; allowed: axis, wheel, ellipse")
    if not runs:
        raise InputError("coasting runs are wanted; none was given")
    keep_apart(data_sets(runs, validation))
    share = spin_share(spec) if wheel_inertia else 0.0

    def predicted(run: Coasting, k: int, values: Mapping[str, float]) -> np.ndarray:
        thrown = values.get(f"along_{k}", 0.0), values.get(f"across_{k}", 0.0)
        way = slide(
            thrown, run.time, law=law, mu_t=values["friction.mu_t"], mu_n=values["friction.mu_n"], share=share
        )
        return run.place - way

    def residuals(values: Mapping[str, float]) -> list[Residual]:
        return _residuals([predicted(run, k, values) for k, run in enumerate(runs)], runs, noise, "fit")

    thrown = [unknown for k, run in enumerate(runs) for unknown in _throw(run, k, noise)]
    found = least_squares(
        residuals, [*unknowns(spec, _NAMES), *thrown], held={"spin_share": share},
        watch=watch,
    )  # fmt: skip
    if not validation or len(found.values) < len(_NAMES):
        return found
    return _validated(found, validation, law, share, noise)


def _throw(run: Coasting, k: int, noise: float) -> list[Unknown]:
    """Return the velocities that can be seen of a throw, as unknowns."""
    few = len(run.time) // 4
    went = np.abs(run.place[-few:].mean(axis=0) - run.place[: max(1, few // 4)].mean(axis=0))
    return [
        Unknown(f"{way}_{k}", "m/s", guess, guess - 2.0, guess + 2.0, 1.0, nuisance=True)
        for way, guess, far in zip(_WAYS, run.velocity, went, strict=True) if far > _SEEN * noise
    ]  # fmt: skip


def _residuals(
    differences: Sequence[np.ndarray], runs: Sequence[Coasting], noise: float, role: Role
) -> list[Residual]:
    """Return residuals by run and direction; where a run began is their mean, and taken out."""
    return [
        Residual(f"{run.name} {way}", "m", values[:, i] - values[:, i].mean(), noise, role)
        for run, values in zip(runs, differences, strict=True)
        for i, way in enumerate(_WAYS)
    ]


def _validated(
    found: Estimate, validation: Sequence[Coasting], law: str, share: float, noise: float
) -> Estimate:
    """Return the estimate with residuals of throws that it has not seen, each thrown as suits it best."""
    mu_t, mu_n = (found.values[name] for name in _NAMES)
    added: list[Residual] = []
    for run in validation:

        def residuals(values: Mapping[str, float], run: Coasting = run) -> list[Residual]:
            thrown = values.get("along_0", 0.0), values.get("across_0", 0.0)
            way = slide(thrown, run.time, law=law, mu_t=mu_t, mu_n=mu_n, share=share)
            return _residuals([run.place - way], [run], noise, "fit")

        thrown = _throw(run, 0, noise)
        seen = least_squares(residuals, thrown).residuals if thrown else residuals({})
        added += [replace(each, role="validation") for each in seen]
    return replace(found, residuals=(*found.residuals, *added))
