r"""Ensemble: members of `compliant` that run beside a robot and are corrected by what it measures.

A member has a pose, velocities, bends, chamber pressures, and its own idea of the robot: a gain and bias of
each module, time constants of its chambers, one stiffness, one μ_t. Where it goes, its bends tell
(`connection`). What the model lacks bends segment j by d_j, which fades with a time constant (a first-order
Gauss–Markov process). The chambers' moment is

$$ \tau_j = k\,\bigl(b_j + \varphi(G\,(g_j^+ p_j^+ - g_j^- p_j^-)) + d_j\bigr), $$

with pressures that relax at the rate o/τ_fill + (1 − o)/τ_vent + λ while a valve is open for the share o of
the time, and change by what is usual besides (`habits`).

Measurements are taken one by one by the ensemble square root filter (Whitaker and Hamill 2002), with

- localisation: a sensor or a pressure corrects its own segment, markers everything;
- inflation: what a correction takes of the spread is given back by a share (relaxation to prior spread,
  Whitaker and Hamill 2012);
- outliers: a number further off than four standard deviations counts as if it were that much noisier;
- rolling: bends, as they are once they have been corrected, carry and turn the body by its local connection
  (`connection`);
- adaptation: what wanders does so more where measurements are further off than expected, and less where they
  are not.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from srs_twin.geometry import body_shape, relative_headings
from srs_twin.live.connection import LocalConnection
from srs_twin.live.ensemble_kernels import advance, correct, set_momenta
from srs_twin.live.habits import Habits
from srs_twin.live.modules import BIAS, FILL, GAIN, VENT, ModuleFilter
from srs_twin.plants.analytical import compliant_kernels, kernels
from srs_twin.plants.analytical.floor import floor_friction
from srs_twin.plants.analytical.kinematics import Solid
from srs_twin.pneumatics.chambers import AMBIENT_PA, free_bends
from srs_twin.pneumatics.lag import relaxation_of, relaxed
from srs_twin.robot.spec import RobotSpec

STEP_S = 0.0025
"""Longest step of the members."""
_MEMORY, _ADAPTS, _SCALES = 25, 0.03, (0.2, 10.0)
"""Measurements that tell how far they are off, by which power of it what wanders follows, and how far."""
_JUDGED, _LEAST_NOISE = 10, {"place": 0.4, "heading": 1.0}
"""Frames that tell how noisy they are, and how quiet they may be, as a multiple of the usual: what arcs miss
of headings lasts, and does not show."""
_ASTRAY, _FRAMES = 6.0, 5
"""By how many standard deviations half of a frame must be off, in how many frames: the robot is elsewhere."""
_DOUBT = 0.2
"""What lags miss of a pressure, as a share of the supply's, for what pressures tell of time constants."""
_APART_S = 0.2
"""Frames further apart tell nothing of how the robot goes."""
_POSE = ("x", "y", "heading")
_MODULES = ("gain", "bias", "fill", "vent")


@dataclass(frozen=True)
class Spreads:
    """How unlike the robot may be to what its file says, standard deviations; and how it changes.

    Attributes:
        gain: of a chamber's gain, as a share.
        bias: of a module's bend without pressure, rad.
        tau: of the chambers' time constants, as a share.
        stiffness: of the bending stiffness, as a share.
        friction: of μ_t, as a share.
        unexplained: d, RMS, rad.
        unexplained_s: over which d fades, s.
        pressure: by what a pressure wanders from its lag before it has been seen, share of the supply's in a
            second.
        drift: by what gains and time constants wander, share in a second; biases a quarter of it, rad.
        slip: by what the place wanders from where bends carry it, m (and rad times half its length) in a
            second.
        turning: yaw rate that bends do not tell, RMS, rad/s.
        turning_s: over which that fades, s.
        inflation: share of a correction's loss of spread that is given back.
    """

    gain: float = 0.12
    bias: float = 0.03
    tau: float = 0.15
    stiffness: float = 0.25
    friction: float = 0.25
    unexplained: float = 0.05
    unexplained_s: float = 0.12
    pressure: float = 0.15
    drift: float = 0.004
    slip: float = 0.003
    turning: float = 0.005
    turning_s: float = 10.0
    inflation: float = 0.3


@dataclass(frozen=True)
class Noise:
    """What measurements may be off by, RMS.

    Attributes:
        bend: of a bend sensor, rad.
        pressure: of a pressure sensor, Pa.
        place: of a marked connector, m: the camera's and what arcs miss of the shape.
        heading: of a marked connector, rad.
    """

    bend: float = 0.02
    pressure: float = 500.0
    place: float = 0.0015
    heading: float = 0.02


@dataclass(frozen=True)
class Air:
    """What the chambers get, as far as faults are known.

    Attributes:
        opens: share of the time for which each valve fills, equal slots of the stretch, shape (slots,
            segments, 2).
        supply: gauge, of each segment, Pa.
        leak: of each chamber, share of its pressure, 1/s, shape (segments, 2).
    """

    opens: np.ndarray
    supply: np.ndarray
    leak: np.ndarray


class Ensemble:
    """Members beside a robot (module docstring).

    Attributes:
        spec: the robot, as its file has it.
        members: one a row; `rows` names the columns.
        rows: name → columns: x, y, heading, motion (forth, aside, yaw rate, bend rates), bend, pressure,
            unexplained, gain, bias, fill, vent, stiffness, friction, turning (rad/s). Time constants,
            stiffness and friction are logarithms over those of the file.
        modules: what gains, biases, time constants and stiffness are drawn from.
        habits: of the chambers' pressures.
        connection: how the robot goes by bending.
        twist: velocity forth, aside (m/s) and yaw rate (rad/s) of the last move.
        placed: whether anybody has told where the robot is.
    """

    def __init__(
        self, spec: RobotSpec, *, members: int = 32, seed: int = 0, spreads: Spreads = Spreads(),
        noise: Noise = Noise(),
    ) -> None:  # fmt: skip
        """Begin at rest, straight, chambers empty, somewhere.

        Args:
            spec: the robot.
            members: how many.
            seed: of their draws.
            spreads: of what they take for possible.
            noise: of what is measured.
        """
        self.spec, self.spreads, self.noise = spec, spreads, noise
        self._rng = np.random.default_rng((seed, 0xE5))
        n = self._segments = spec.segments
        sizes = {
            **dict.fromkeys(_POSE, 1), "motion": 3 + n, "bend": n, "pressure": 2 * n, "unexplained": n,
            "gain": 2 * n, "bias": n, "fill": n, "vent": n, "stiffness": 1, "friction": 1, "turning": 1,
        }  # fmt: skip
        ends = np.cumsum([0, *sizes.values()])
        self.rows: Mapping[str, slice] = {
            name: slice(int(a), int(b)) for name, a, b in zip(sizes, ends[:-1], ends[1:], strict=True)
        }
        g, mu = spec.geometry, spec.friction
        self._solid = Solid(spec.mass.array(), spec.yaw_inertia(), g.segment_length, g.rigid_gap, 0.0)
        lean, drag = g.com_height / (2 * g.half_track), mu.drag / g.connectors
        self._floor = floor_friction("wheel", g.half_track, mu.mu_t, mu.mu_n, 0.001, lean, drag=drag)
        self._mass = self._solid.mass
        self.members = np.zeros((members, int(ends[-1])))
        s = spreads
        sd = np.array([s.gain, s.gain, s.bias, s.tau, s.tau, s.unexplained])
        walk = np.array([s.drift, s.drift, s.drift / 4, s.drift, s.drift])
        self.modules = ModuleFilter(n, sd, walk, s.unexplained_s)
        self._own = {name: self._drawn(name) for name in _MODULES}
        for name, wide in (("stiffness", s.stiffness), ("friction", s.friction)):
            self._of(name)[:] = wide * self._drawn(name)
        self._of("unexplained")[:] = s.unexplained * self._drawn("unexplained")
        self._of("turning")[:] = s.turning * self._drawn("turning")
        self._draw_modules()
        self._of("bend")[:] = self._of("bias")
        self._supply = spec.supply.nominal
        self._masks = self._local()
        self.habits = Habits(n, self._supply, s.pressure)
        self._scales = {"unexplained": np.ones(n), "place": np.ones(1)}
        self._found = {name: np.ones_like(each) for name, each in self._scales.items()}
        self._noise = {name: getattr(noise, name) for name in _LEAST_NOISE}
        self.connection = LocalConnection(spec, self._mass)
        self._parts = np.zeros(len(self.connection.weights))
        self._unlike = self._rng.normal(size=(members, len(self._parts), 3))
        self._unlike -= self._unlike.mean(axis=0)
        self._foresees = False
        # The bends with which they went last, and how long ago that was.
        self._shape, self._bent_for = self._of("bend").copy(), 0.0
        # What bends have not told of the turning since the last frame, how long ago that was; velocities.
        self._turned, self._since, self.twist = 0.0, math.inf, np.zeros(3)
        self.placed, self._astray = False, 0
        self._before: np.ndarray | None = None
        self._states = np.zeros((members, kernels.STATES + 2 * n))
        self._momenta()
        self._compile()

    def advance(self, air: Air, span: float) -> None:
        """Go on for a stretch (s)."""
        self.move(air, span)
        actuator, opens = self.spec.actuator, air.opens.mean(axis=0)
        times = actuator.tau_fill * np.exp(self.mean("fill")), actuator.tau_vent * np.exp(self.mean("vent"))
        rates = np.stack([*(np.repeat(1 / each[:, None], 2, axis=1) for each in times), air.leak])
        self.modules.advance(span)
        self.modules.fill(opens, self.mean("pressure").reshape(-1, 2), air.supply, rates, span)

    def move(self, air: Air, span: float, step: float = STEP_S) -> None:
        """Have the members go on, and wander.

        Args:
            air: what the chambers get.
            span: for how long, s.
            step: longest step, s.
        """
        self._relax()
        s, root, scale = self.spreads, math.sqrt(span), self._scales
        fades = math.exp(-span / s.unexplained_s)
        unexplained = self._of("unexplained")
        unexplained *= fades
        unexplained += (
            scale["unexplained"] * s.unexplained * math.sqrt(1 - fades**2) * self._drawn("unexplained")
        )
        self._run(air, span, step)
        turning, fades = self._of("turning"), math.exp(-span / s.turning_s)
        self._of("heading")[:] += span * turning
        self._turned += span * float(turning.mean())
        self._since += span
        self._bent_for += span
        turning *= fades
        turning += s.turning * math.sqrt(1 - fades**2) * self._drawn("turning")
        half = self.spec.geometry.body_length / 2
        slides = self._rng.normal(size=(len(self.members), 3)) * [1.0, 1.0, 1 / half]
        self.members[:, :3] += scale["place"] * s.slip * root * slides
        self._momenta()

    def _relax(self) -> None:
        """Give back a share of the spread that corrections since the last move have taken."""
        if self._before is None:
            return
        after = self.members.std(axis=0)
        grown = 1 + self.spreads.inflation * np.maximum(self._before - after, 0.0) / np.maximum(after, 1e-12)
        middle = self.members.mean(axis=0)
        self.members[:] = middle + grown * (self.members - middle)
        self._before = None
        self._momenta()

    def read_bends(self, bends: np.ndarray) -> np.ndarray:
        """Take sensor readings, shape (segments,), rad, NaN where there are none.

        Returns:
            What they are off by, over the standard deviation that was expected, NaN where there are none.
        """
        variances = np.full(self._segments, self.noise.bend**2)
        off = self._correct(self._of("bend").copy(), bends, variances, self._masks["bend"], together=False)
        self._adapt("unexplained", off)
        self._learn(~np.isnan(bends))
        return off

    def read_pressures(self, pressure: np.ndarray) -> np.ndarray:
        """Take pressures, gauge, shape (segments, 2), Pa; returns as `read_bends`, shape (2 segments,)."""
        noise, given = self.noise.pressure, self._of("pressure")
        off = pressure - given.mean(axis=0).reshape(-1, 2)
        self.habits.learn(off, noise)
        variance = given.var(axis=0, ddof=1).reshape(-1, 2)
        told = self._correct(
            given.copy(),
            pressure.ravel(),
            np.full(given.shape[1], noise**2),
            self._masks["pressure"],
            together=False,
        )  # fmt: skip
        # What lags miss of a pressure comes again and again: so much less does one of them tell.
        doubt = np.sqrt(noise**2 + variance) + _DOUBT * self._supply
        self.modules.read_pressures(off, doubt, variance / (variance + noise**2))
        return told

    def read_poses(self, poses: np.ndarray) -> np.ndarray:
        """Take where connectors are: x, y (m), heading (rad), shape (connectors, 3), NaN where not seen.

        The first ones, and the first after the robot was lost, say where the members are.

        Returns:
            As `read_bends`, shape (3 connectors,).
        """
        self.roll()
        if not self.placed:
            self._place(poses)
            self._since = math.inf
        pose, bend = self.members[:, :3].mean(axis=0), self.mean("bend")
        predicted = self.poses()
        turn = poses[:, 2] - predicted[:, :, 2].mean(axis=0)
        poses = np.column_stack([poses[:, :2], poses[:, 2] - 2 * np.pi * np.round(turn / (2 * np.pi))])
        apart = poses - predicted.mean(axis=0)
        found = predicted.reshape(len(self.members), -1)
        masks = np.broadcast_to(self._masks["pose"], (found.shape[1], self.members.shape[1]))
        variances = np.tile([self._noise[name] ** 2 for name in ("place", "place", "heading")], len(poses))
        off = self._correct(found, poses.ravel(), variances, masks, together=True)
        astray = False
        if not np.isnan(off).all():
            self._adapt("place", np.sqrt(np.nanmean(off**2, keepdims=True)))
            left = poses - self.poses().mean(axis=0)
            for name, some in (("place", slice(2)), ("heading", 2)):
                self._judge(name, apart[:, some], left[:, some])
            astray = bool(np.nanmedian(np.abs(off)) > _ASTRAY)
        if astray:
            self._since = math.inf
        self._went(pose, bend)
        self._shape[:] = self._of("bend")
        self._astray = self._astray + 1 if astray else 0
        if self._astray >= _FRAMES:  # it was carried away, or begins anew
            self.placed, self._astray = False, 0
        seen = ~np.isnan(poses[:, 2])
        self._learn(seen[1:] & seen[:-1])
        return off

    def roll(self) -> None:
        """Have members go where their bends have carried the body since they last went.

        Beside a robot all go as their mean does, but for what robots of the same bends may go by otherwise:
        what each believes of a bend comes and goes, and would turn it at random. So do a model's errors,
        which readings take back: the way leads straight from what was known then to what is known now.
        """
        if not self._bent_for:
            return
        connection, bend, before = self.connection, self._of("bend"), self._shape
        was, now = before.mean(axis=0), bend.mean(axis=0)
        parts = connection.parts(was, now)
        bent = bend - before if self._foresees else now - was
        went = bent @ connection.at((was + now) / 2).T + connection.unsure(parts, self._unlike)
        heading = self._of("heading")[:, 0] + went[:, 2] / 2
        c, s, x, y = np.cos(heading), np.sin(heading), went[:, 0], went[:, 1]
        self.members[:, :3] += np.column_stack([c * x - s * y, s * x + c * y, went[:, 2]])
        self.twist = went.mean(axis=0) / self._bent_for
        self._parts += parts
        self._shape, self._bent_for = bend.copy(), 0.0
        self._momenta()

    def poses(self) -> np.ndarray:
        """Return x, y (m), heading (rad) of the connectors, shape (members, connectors, 3)."""
        bend = self._of("bend")
        x, y, heading = (self._of(name)[:, 0] for name in _POSE)
        g = self.spec.geometry
        shape = body_shape(bend, self._mass, g.segment_length, g.rigid_gap)
        c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
        return np.stack(
            [
                x[:, None] + c * shape[..., 0] - s * shape[..., 1],
                y[:, None] + s * shape[..., 0] + c * shape[..., 1],
                heading[:, None] + relative_headings(bend),
            ],
            axis=-1,
        )

    @property
    def rough(self) -> float:
        """How many times as noisy as usual the headings of motion capture are."""
        return self._noise["heading"] / self.noise.heading

    def mean(self, name: str) -> np.ndarray:
        """Return the mean of some columns."""
        return np.asarray(self._of(name).mean(axis=0))

    def sd(self, name: str) -> np.ndarray:
        """Return the standard deviation of some columns."""
        return np.asarray(self._of(name).std(axis=0, ddof=1))

    def parameters(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return what the robot is thought to be: name → values and standard deviations.

        Gains of each chamber, biases (rad), time constants of filling and venting of each module, and
        stiffness and μ_t of all, but for biases as multiples of the file's.
        """
        mean, sd = self.modules.mean, np.sqrt(np.einsum("sii->si", self.modules.covariance))
        found = {"gain": (mean[:, GAIN], sd[:, GAIN]), "bias_rad": (mean[:, BIAS], sd[:, BIAS])}
        logarithms = {
            "tau_fill": (mean[:, FILL], sd[:, FILL]), "tau_vent": (mean[:, VENT], sd[:, VENT]),
            **{name: (self.mean(name), self.sd(name)) for name in ("stiffness", "friction")},
        }  # fmt: skip
        for name, (middle, wide) in logarithms.items():
            found[name] = np.exp(middle), np.exp(middle) * wide
        return found

    def copy(self, members: int | None = None) -> Ensemble:
        """Return an ensemble of some or all members that goes on without measurements."""
        other = copy.copy(self)
        some, bend = self.members[:members], self.rows["bend"]
        other.members, other._states = some.copy(), self._states[:members].copy()
        if len(some) < len(self.members):  # with the mean and the spread of all
            share = self.members.std(axis=0) / np.maximum(some.std(axis=0), 1e-300)
            other.members[:] = self.members.mean(axis=0) + share * (some - some.mean(axis=0))
        other._foresees, other._unlike, other._parts = True, self._unlike[:members], self._parts.copy()
        other._shape = self._shape[:members] + other.members[:, bend] - some[:, bend]
        other._before = None
        other._own = {name: own[:members] for name, own in self._own.items()}
        other._scales = {name: each.copy() for name, each in self._scales.items()}
        other.habits = copy.deepcopy(self.habits)
        other.connection = self.connection.snapshot()
        other._rng = np.random.default_rng(0)
        other._momenta()
        return other

    def ahead(self, members: int) -> Callable[[Iterable[Air], float], np.ndarray]:
        """Return what tells where some members, as they are now, will be without measurements.

        Args:
            members: how many are taken.

        Returns:
            A function of the air of one stretch after another, and the length of each (s): x, y (m) and mean
            heading (rad) at the end of each, shape (stretches, members, 3).
        """
        other = self.copy(members)

        def go(airs: Iterable[Air], span: float) -> np.ndarray:
            found = []
            for air in airs:
                other.move(air, span)
                other.roll()
                found.append(other.members[:, :3].copy())
            return np.array(found)

        return go

    def _compile(self) -> None:
        """Have all kernels compiled, which may take seconds, before the robot is heard."""
        n = self._segments
        air = Air(np.zeros((1, n, 2)), np.zeros(n), np.zeros((n, 2)))
        self.ahead(2)([air], STEP_S)
        nothing = np.full((len(self.members), n), 0.0), np.full(n, np.nan), np.ones(n)
        correct(self.members.copy(), *nothing, self._masks["bend"], False)
        correct(
            self.members.copy(),
            *nothing,
            np.broadcast_to(self._masks["pose"], self._masks["bend"].shape),
            True,
        )

    def _of(self, name: str) -> np.ndarray:
        return self.members[:, self.rows[name]]

    def _drawn(self, name: str) -> np.ndarray:
        """Return standard normal numbers for some columns, of mean 0 over the members."""
        found = self._rng.normal(size=self._of(name).shape)
        return np.asarray(found - found.mean(axis=0))

    def _local(self) -> dict[str, np.ndarray]:
        """Return which columns each kind of measurement corrects, one row a number."""
        n, width = self._segments, self.members.shape[1]
        bend, pressure = np.zeros((n, width)), np.zeros((2 * n, width))
        for j in range(n):
            # A bend follows its pressures, so what lags missed of one since the last message moved both.
            own = [self.rows[name].start + j for name in ("bend", "unexplained")]
            own.append(self.rows["motion"].start + 3 + j)
            bend[j, own] = pressure[np.ix_([2 * j, 2 * j + 1], own)] = 1.0
            for side in (0, 1):
                chamber = self.rows["pressure"].start + 2 * j + side
                bend[j, chamber] = pressure[2 * j + side, chamber] = 1.0
        pose = np.zeros(width)
        for name in (*_POSE, "bend", "unexplained", "turning"):
            pose[self.rows[name]] = 1.0
        return {"bend": bend, "pressure": pressure, "pose": pose}

    def _correct(
        self,
        predicted: np.ndarray,
        told: np.ndarray,
        variances: np.ndarray,
        masks: np.ndarray,
        *,
        together: bool,
    ) -> np.ndarray:
        if self._before is None:
            self._before = self.members.std(axis=0)
        off = correct(self.members, predicted, told, variances, masks, together)
        pressure = self._of("pressure")
        np.maximum(pressure, -AMBIENT_PA, out=pressure)  # a chamber that is pulled open sucks
        self._momenta()
        return off

    def _went(self, pose: np.ndarray, bend: np.ndarray) -> None:
        """Learn how the robot goes from a frame, which has corrected this mean pose and these bends."""
        connection, now = self.connection, self.mean("bend")
        if self._since < _APART_S:
            x, y, turn = self.members[:, :3].mean(axis=0) - pose
            c, s = math.cos(pose[2]), math.sin(pose[2])
            off = [c * x + s * y, c * y - s * x, turn + self._turned]
            missed = off + self._parts @ connection.weights
            missed -= connection.of_wheels((bend + now) / 2) @ (now - bend)
            connection.learn(self._parts + connection.parts(bend, now), missed)
        self._parts[:], self._turned, self._since = 0.0, 0.0, 0.0

    def _judge(self, name: str, before: np.ndarray, after: np.ndarray) -> None:
        """Learn how noisy frames are from what they are off by before and after they have corrected.

        Where that is noise the two are alike (Desroziers and others 2005).
        """
        if np.isnan(before * after).all():
            return
        usual, now = getattr(self.noise, name), self._noise[name] ** 2
        told = min(max(float(np.nanmean(before * after)), 0.0), 4 * now)
        found = math.sqrt(now + (told - now) / _JUDGED)
        self._noise[name] = min(max(found, _LEAST_NOISE[name] * usual), _SCALES[1] * usual)

    def _adapt(self, name: str, off: np.ndarray) -> None:
        """Let what wanders wander more where measurements are further off than expected, else less."""
        found = self._found[name]
        found += np.where(np.isnan(off), 0.0, (off**2 - found) / _MEMORY)
        scale = self._scales[name]
        np.clip(np.where(np.isnan(off), scale, scale * found**_ADAPTS), *_SCALES, out=scale)

    def _learn(self, measured: np.ndarray) -> None:
        """Tell the modules what bends could not be explained, of the segments that were measured."""
        d, pressure = self._of("unexplained"), self.mean("pressure").reshape(-1, 2)
        modules, actuator = self.modules, self.spec.actuator
        used = np.empty((self._segments, 5))
        used[:, GAIN] = self.mean("gain").reshape(-1, 2)
        for column, name in ((BIAS, "bias"), (FILL, "fill"), (VENT, "vent")):
            used[:, column] = self.mean(name)
        signed = actuator.gain * np.array([1.0, -1.0])
        told = np.where(measured, d.mean(axis=0), np.nan)
        modules.read_unexplained(told, d.var(axis=0, ddof=1), used, signed * pressure, signed * used[:, GAIN])
        self._draw_modules()

    def _draw_modules(self) -> None:
        """Give members modules of what is known of them; deviations stay, as far as they are possible."""
        mean, sd = self.modules.mean, np.sqrt(np.einsum("sii->si", self.modules.covariance))
        for name, at in (("gain", GAIN), ("bias", BIAS), ("fill", FILL), ("vent", VENT)):
            self._of(name)[:] = np.ravel(mean[:, at]) + np.ravel(sd[:, at]) * self._own[name]

    def _place(self, poses: np.ndarray) -> None:
        """Lay the members where connectors were seen."""
        seen = ~np.isnan(poses).any(axis=1)
        if not seen.any():
            return
        _, _, own = (self.poses()[:, seen, k] for k in range(3))
        turn = poses[seen, 2] - own
        self._of("heading")[:, 0] += np.arctan2(np.sin(turn).mean(axis=1), np.cos(turn).mean(axis=1))
        apart = poses[seen, :2] - self.poses()[:, seen, :2]
        self.members[:, :2] += apart.mean(axis=1)
        self.members[:, :2] += 5 * self.noise.place * self._rng.normal(size=(len(self.members), 2))
        self._of("heading")[:, 0] += 2 * self.noise.heading * self._rng.normal(size=len(self.members))
        self.placed = True

    def _run(self, air: Air, span: float, step: float) -> None:
        """Have the bodies move as the chambers bend them."""
        n, count, slots = self._segments, len(self.members), len(air.opens)
        a, spec = self.spec.actuator, self.spec
        steps = math.ceil(span / slots / step - 1e-6)
        h = span / slots / steps
        fill = (a.tau_fill * np.exp(self._of("fill")))[:, :, None]
        vent = (a.tau_vent * np.exp(self._of("vent")))[:, :, None]
        gain = a.gain * self._of("gain").reshape(count, n, 2)
        pressure = self._of("pressure").reshape(count, n, 2)
        # What pressures wander by while the bodies move bends these as well.
        wander = self._drawn("pressure").reshape(count, n, 2) / math.sqrt(span)
        after = (np.arange(steps)[:, None] + [kernels.GAMMA, 1.0]).ravel() * h
        drive = np.empty((slots, 2 * steps, count, n))
        for k, opens in enumerate(air.opens):
            place = self.habits.let(opens, span / slots)
            besides = self.habits.rate[place] + wander * np.sqrt(self.habits.wander[place])
            supply, venting = air.supply[:, None], (1 - opens) / vent
            rate, end = relaxation_of(opens / fill, venting, supply, air.leak, besides)
            passed = relaxed(pressure, rate, end, after[:, None, None, None])
            drive[k] = gain[..., 0] * passed[..., 0] - gain[..., 1] * passed[..., 1]
            pressure = passed[-1]
        self._of("pressure")[:] = pressure.reshape(count, 2 * n)
        free = self._of("bias") + free_bends(spec, drive) + self._of("unexplained")
        springs = self._springs()
        moments = np.ascontiguousarray((springs[:, 0, None] * free).transpose(2, 0, 1, 3))
        moments = moments.reshape(count, slots * steps, 2, n)
        mu = spec.friction.mu_t * np.exp(self._of("friction")[:, 0])
        velocities = self._of("motion").copy()
        fine = advance(self._states, velocities, np.full(slots * steps, h), moments, springs, mu,
                        self._solid, self._floor)  # fmt: skip
        wrong = ~fine | ~np.isfinite(self._states).all(axis=1) | (np.abs(velocities[:, :3]).max(axis=1) > 20)
        self._of("motion")[:] = velocities
        self._of("bend")[:] = self._states[:, compliant_kernels.BENDS :][:, :n]
        if wrong.all():
            self._rest()
        elif wrong.any():
            # A member that diverged begins anew as another one is.
            others = self._rng.choice(np.flatnonzero(~wrong), size=int(wrong.sum()))
            self.members[wrong] = self.members[others]

    def _rest(self) -> None:
        """Begin anew, at rest, somewhere."""
        modules = self.rows["gain"].start
        self.members[:, :modules] = 0.0
        self._of("friction")[:] = self.spreads.friction * self._drawn("friction")
        self._of("turning")[:] = self.spreads.turning * self._drawn("turning")
        self._draw_modules()
        self._of("bend")[:] = self._of("bias")
        self._shape, self.placed = self._of("bend").copy(), False
        self._momenta()

    def _springs(self) -> np.ndarray:
        """Return stiffness (N·m/rad) and damping (N·m·s/rad) of each member, shape (members, 2)."""
        bending, factor = self.spec.bending, np.exp(self._of("stiffness"))
        return np.asarray(factor * [bending.stiffness, bending.damping])

    def _momenta(self) -> None:
        """Fill the bodies' states from what they are in `members`."""
        n = self._segments
        self._states[:, [kernels.STATE_X, kernels.STATE_Y, kernels.HEADING]] = self.members[:, :3]
        self._states[:, compliant_kernels.BENDS :][:, :n] = self._of("bend")
        set_momenta(self._states, self._of("motion").copy(), self._springs(), self._solid, self._floor)
