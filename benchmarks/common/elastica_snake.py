"""Continuum snake of PyElastica: rod, muscles, floor and damping of its example, with default settings.

The problem is ContinuumSnakeCase of the PyElastica repository (Zhang et al., Nat.
Commun. 2021): a rod of 0.35 m with 50 elements, a travelling wave of muscle torque with
a period of 2 s, anisotropic Coulomb friction on a plane, and position Verlet with steps
of 0.1 ms. Only the public API is used. The example records 60 times per simulated
second; `ContinuumSnake` can omit the records.
"""

from __future__ import annotations

from typing import Any

import elastica as ea
import numpy as np

TIMESTEP = 1e-4
"""Time step of the example, s."""

ELEMENTS = 50
PERIOD = 2.0  # s, of the muscle wave
LENGTH = 0.35  # m
RADIUS = 0.011 * LENGTH
GRAVITY = 9.80665
FROUDE = 0.1
MU = LENGTH / (PERIOD**2 * GRAVITY * FROUDE)
MU_FRACTIONS = np.array([1.0, 1.5, 2.0])  # forward, backward, sideways
SPLINE = np.array(
    [3.4e-3, 3.3e-3, 4.2e-3, 2.6e-3, 3.6e-3, 3.5e-3]
)  # N·m along the body
WAVE_LENGTH = 1.0  # body lengths
UP = np.array([0.0, 1.0, 0.0])
AHEAD = np.array([0.0, 0.0, 1.0])
RECORD_HZ = 60


class _Simulator(
    ea.BaseSystemCollection,
    ea.Constraints,
    ea.Forcing,
    ea.Damping,
    ea.CallBacks,
    ea.Contact,
):
    """Simulator with the features that the example uses."""


class _Recorder(ea.CallBackBaseClass):
    """Callback that records the same quantities as the example."""

    def __init__(self, every: int, kept: dict[str, list[Any]]) -> None:
        super().__init__()
        self.every = every
        self._kept = kept

    def make_callback(self, system: Any, time: float, current_step: int) -> None:
        """Append one record."""
        if current_step % self.every:
            return
        for name, value in (
            ("time", time),
            ("step", current_step),
            ("position", system.position_collection.copy()),
            ("velocity", system.velocity_collection.copy()),
            ("avg_velocity", system.compute_velocity_center_of_mass()),
            ("center_of_mass", system.compute_position_center_of_mass()),
            ("curvature", system.kappa.copy()),
        ):
            self._kept.setdefault(name, []).append(value)


class ContinuumSnake:
    """The problem, initially at rest.

    Attributes:
        time: simulated time, s.
        kept: recorded quantities by name, one item per record.
    """

    def __init__(self, *, record: bool = True) -> None:
        """Create rod, floor, muscles, friction and damping.

        Args:
            record: whether to record the quantities of the example.
        """
        self.time = np.float64(0.0)
        self.kept = {}
        self._simulator = _Simulator()
        self._stepper = ea.PositionVerlet()
        rod = _rod()
        self._simulator.append(rod)
        self._add_floor(rod)
        self._add_muscles(rod)
        self._simulator.add_forcing_to(rod).using(
            ea.GravityForces, acc_gravity=-GRAVITY * UP
        )
        self._simulator.dampen(rod).using(
            ea.AnalyticalLinearDamper, damping_constant=2e-3, time_step=TIMESTEP
        )
        if record:
            every = int(1 / (RECORD_HZ * TIMESTEP))
            self._simulator.collect_diagnostics(rod).using(
                _Recorder, every=every, kept=self.kept
            )
        self._simulator.finalize()

    def advance(self, duration: float) -> None:
        """Simulate for a duration (s), as `ea.integrate` does but without its progress bar."""
        step = np.float64(TIMESTEP)
        for _ in range(round(duration / TIMESTEP)):
            self.time = self._stepper.step(self._simulator, self.time, step)

    def _add_floor(self, rod: ea.CosseratRod) -> None:
        floor = ea.Plane(plane_origin=-RADIUS * UP, plane_normal=UP)
        self._simulator.append(floor)
        self._simulator.detect_contact_between(rod, floor).using(
            ea.RodPlaneContactWithAnisotropicFriction,
            k=1.0,
            nu=1e-6,
            slip_velocity_tol=1e-8,
            static_mu_array=np.zeros(3),
            kinetic_mu_array=MU * MU_FRACTIONS,
        )

    def _add_muscles(self, rod: ea.CosseratRod) -> None:
        self._simulator.add_forcing_to(rod).using(
            ea.MuscleTorques,
            base_length=LENGTH,
            b_coeff=SPLINE,
            period=PERIOD,
            wave_number=2 * np.pi / WAVE_LENGTH,
            phase_shift=0.0,
            rest_lengths=rod.rest_lengths,
            ramp_up_time=PERIOD,
            direction=UP,
            with_spline=True,
        )


def _rod() -> ea.CosseratRod:
    young = 1e6
    poisson = 0.5
    return ea.CosseratRod.straight_rod(
        ELEMENTS,
        np.zeros(3),
        AHEAD,
        UP,
        LENGTH,
        RADIUS,
        1000.0,  # kg/m³
        youngs_modulus=young,
        shear_modulus=young / (poisson + 1),  # as in the example
    )
