r"""Contact force from valve commands, pressures and sensed bends: a disturbance observer on the actuator law.

A segment bends by the free bend of its pressures and by the external moment M_j on it,

$$ q_j = b_j + \varphi_j(p) + M_j/k . $$

In a steady gait all terms repeat with the period of the commands. The observer learns the mean of q_j and φ_j
in each phase of the period, so that module spread, sensor offsets and the moments of the floor cancel. The
deviation

$$ e_j = (q_j - \bar q_j) - (\varphi_j - \bar\varphi_j) $$

is the moment of a contact over k. The pressures are measured, so a drift of the supply and the air that a
contact compresses in closed chambers are not mistaken for a contact.

**Statics.** Inertia and the friction against the additional slip balance a force F at a place s, normal to
the body. Both reactions are assumed proportional to the mass of a connector and to the motion of a rigid
body; friction acts across the wheels only. This gives the moments F·m_j(s) of the present shape. The moments
of four or more segments determine the two unknowns, F and s. A force along the body is not observable, and
two simultaneous contacts appear as one. A force near an end bends the body like a smaller opposite force near
the second quarter from that end; the intervals contain both places.

**Estimate.** For each place s on a grid, F(s) is the weighted least-squares fit over a window. The score of
a place is F(s) over its standard deviation; the place with the largest score is the estimate. Learning stops
while the score is high.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.saved_state import Stateful
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.robot.geometry import body_shape, relative_headings
from srs_twin.robot.spec import RobotSpec

WINDOW_S = 0.3
"""Duration of the window of an estimate; contacts of at least this duration must be detected."""
SETTLING_S = 2.0
"""Duration of the transient after the start of a gait, which is not learnt."""
LEARNING_S = 10.0
"""Duration of free crawling before estimates begin."""
THRESHOLD = 6.0
"""Score above which a contact is detected; benchmarks/contact_estimate.py, robots with seeds from 1000."""
_LEARNING_SCORE = 4.0  # score above which the means are kept
_MEMORY = 20  # periods over which the means are taken
_SAME_COMMAND = 0.1  # largest change of a duty within the same gait
_STATIONS_PER_SEGMENT = 4
_CUTS = (0.25, 0.75)  # fractions of a segment at which its moment is averaged
_ADMITTED = 3.84  # decrease of the squared score within a 95 % interval of the place
_MODEL_ERROR = 0.25  # relative error of the moments due to the assumed reactions


@dataclass(frozen=True)
class ContactEstimate:
    """Estimated contact in the last window.

    Attributes:
        touched: whether a contact is detected.
        score: force over its standard deviation by sensor noise.
        force: normal force, positive to the left of the body, N.
        force_interval: 95 % interval of the force, N.
        place: distance behind the first connector along the body, m.
        place_interval: 95 % interval of the place, m.
    """

    touched: bool
    score: float
    force: float
    force_interval: tuple[float, float]
    place: float
    place_interval: tuple[float, float]


def moment_patterns(spec: RobotSpec, bend: np.ndarray, stations: np.ndarray) -> np.ndarray:
    """Return the moments on the segments per normal force at places of the body, (stations, segments), m.

    Args:
        spec: the robot.
        bend: shape (segments,), rad.
        stations: distances behind the first connector, m.
    """
    g, mass = spec.geometry, spec.mass.array()
    place = body_shape(bend, mass, g.segment_length, g.rigid_gap)
    heading = relative_headings(bend)

    def along(station: np.ndarray, values: np.ndarray) -> np.ndarray:
        j = np.minimum((station / g.pitch).astype(int), spec.segments - 1)
        share = (station / g.pitch - j).reshape(-1, *[1] * (values.ndim - 1))
        return np.asarray(values[j] + share * (values[j + 1] - values[j]))

    # Reaction of each connector per generalised motion (x, y, rotation) of the rigid body, shape (N, 2, 3).
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    aside = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
    # Inertia resists in all directions, friction of wheels mostly across: equal parts of both.
    axial = (1 + spec.friction.mu_t / spec.friction.mu_n) / 2
    grip = np.einsum("ia,ib->iab", aside, aside) + axial * np.einsum("ia,ib->iab", ahead, ahead)
    motion = np.zeros((len(mass), 2, 3))
    motion[:, 0, 0] = motion[:, 1, 1] = 1.0
    motion[:, 0, 2], motion[:, 1, 2] = -place[:, 1], place[:, 0]
    reaction = np.einsum("i,iab,ibk->iak", mass, grip, motion)
    resistance = np.einsum("iak,ial->kl", motion, reaction)
    resistance[2, 2] += spec.yaw_inertia().sum()
    point, angle = along(stations, place), along(stations, heading)
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    load = np.column_stack([normal, _cross(point, normal)])
    accelerations = np.linalg.solve(resistance, load.T).T
    forces = -np.einsum("iak,sk->sia", reaction, accelerations)
    couples = -np.outer(accelerations[:, 2], spec.yaw_inertia())
    patterns = np.zeros((len(stations), spec.segments))
    for j in range(spec.segments):
        for share in _CUTS:
            station = np.array([(j + share) * g.pitch])
            cut = along(station, place)[0]
            moment = (_cross(place - cut, forces) + couples)[:, : j + 1].sum(axis=1)
            moment += np.where(stations < station[0], _cross(point - cut, normal), 0.0)
            patterns[:, j] += moment / len(_CUTS)
    return patterns


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


class ContactObserver(Stateful):
    """Observer of the contact force of a snake in a periodic gait (module docstring).

    Attributes:
        period: period of the commands in samples; 0 without one.
    """

    state_attributes = ("period", "_count", "_changed", "_bins", "_sums", "_variance", "_window", "_samples")

    def __init__(self, spec: RobotSpec, sample_s: float, period: int = 0) -> None:
        """Create the observer, without learnt means.

        Args:
            spec: the robot.
            sample_s: time between samples, s.
            period: period of the commands in samples; may be set later by `set_period`.

        Raises:
            InputError: the robot has fewer than two segments.
        """
        if spec.segments < 2:
            raise InputError("contact estimates need a robot with two or more segments")
        self._spec, self._sample = spec, sample_s
        g = spec.geometry
        self.stations = np.linspace(0.0, g.body_length, _STATIONS_PER_SEGMENT * spec.segments + 1)
        self._length = max(round(WINDOW_S / sample_s), 1)
        self.set_period(period)

    def set_period(self, period: int) -> None:
        """Set the period of the commands in samples, and discard the means of another period."""
        n = self._spec.segments
        self.period, self._samples, self._count, self._changed = period, 0, 0, 0
        self._bins = np.zeros(max(period, 1), dtype=int)
        self._sums = np.zeros((max(period, 1), 4, n))  # means of bend, free bend and both commands
        self._variance = np.zeros(n)
        self._window: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=self._length)

    def skip(self, samples: int) -> None:
        """Advance by a number of missing samples."""
        self._samples += samples

    def update(self, command: np.ndarray, pressure: np.ndarray, sensed: np.ndarray) -> ContactEstimate | None:
        """Add one sample; return the estimate, or None while the observer learns.

        Args:
            command: mean valve states since the last sample, shape (segments, 2).
            pressure: measured gauge pressures, shape (segments, 2), Pa.
            sensed: bend readings, shape (segments,), rad; NaN where they are missing.
        """
        if not self.period:
            return None
        k = self._samples % self.period
        self._samples += 1
        if self._samples * self._sample < SETTLING_S:
            return None
        free = air_bend(self._spec, np.asarray(pressure, dtype=float))
        mean, known = self._sums[k], self._bins[k]
        if known and np.abs(np.asarray(command).T - mean[2:]).max() > _SAME_COMMAND:
            self._changed += 1
            if self._changed > self.period // 2:
                self.set_period(self.period)  # another gait, not a lost command
            return None
        self._changed = 0
        if not np.isfinite(sensed).all() or not np.isfinite(free).all():
            return None
        sample = np.stack([sensed, free, *np.asarray(command, dtype=float).T])
        estimate = self._estimate(sample, mean, known) if known else None
        if estimate is None or estimate.score < _LEARNING_SCORE:
            self._bins[k] = min(known + 1, _MEMORY)
            mean += (sample - mean) / self._bins[k]
        learnt = self._samples * self._sample >= SETTLING_S + LEARNING_S
        return estimate if learnt and len(self._window) == self._length else None

    def _estimate(self, sample: np.ndarray, mean: np.ndarray, known: int) -> ContactEstimate:
        # The mean of few samples is uncertain, too.
        error = (sample[0] - mean[0] - sample[1] + mean[1]) * math.sqrt(known / (known + 1))
        variance = self._variance if self._variance.all() else error**2 + 1e-12
        patterns = moment_patterns(self._spec, sample[0], self.stations) / self._spec.bending.stiffness
        weighted = patterns * math.sqrt(known / (known + 1)) / variance
        fit = weighted @ error, (weighted * patterns).sum(axis=1) * math.sqrt(known / (known + 1))
        self._window.append(fit)
        moment, information = (np.sum(values, axis=0) for values in zip(*self._window, strict=True))
        forces, scores = moment / information, moment / np.sqrt(information)
        best = int(np.argmax(np.abs(scores)))
        if abs(scores[best]) < _LEARNING_SCORE or self._samples * self._sample < SETTLING_S + LEARNING_S:
            self._count += 1
            self._variance = self._variance + (error**2 - self._variance) / min(
                self._count, round(LEARNING_S / self._sample)
            )
        admitted = scores**2 >= (1 - _MODEL_ERROR**2) * scores[best] ** 2 - _ADMITTED
        spread = 1.96 * np.hypot(1 / np.sqrt(information), _MODEL_ERROR * forces)
        step = self._spec.geometry.pitch / _STATIONS_PER_SEGMENT
        places = self.stations[admitted]
        return ContactEstimate(
            touched=bool(abs(scores[best]) > THRESHOLD),
            score=float(abs(scores[best])),
            force=float(forces[best]),
            force_interval=(
                float((forces - spread)[admitted].min()), float((forces + spread)[admitted].max())
            ),
            place=float(self.stations[best]),
            place_interval=(float(places.min() - step), float(places.max() + step)),
        )  # fmt: skip
