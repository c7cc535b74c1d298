"""Work and energy: the work of the segments is the energy of the body plus the losses, on every plant."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from free_bends import free_bends
from scipy.integrate import cumulative_simpson, cumulative_trapezoid
from smooth import Wave
from snakes import robot

from srs_twin import AnalyticalSnake, Gait, RobotSpec, TwinSnake, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.plants.base import SnakeState

SUPPLY = 48.3e3
MODELS = {
    "complete": {},
    "lumped": {"inertia": "lumped"},
    "simplified": {"model": "simplified"},
    "no torque": {"model": "simplified", "friction_torque": False},
    "compliant": {"model": "compliant"},
}


def slow_but(quick, cases):
    """Return test cases, slow except for the quick ones, because kernels compile per model and law."""
    return [
        pytest.param(case, id=name, marks=[] if name in quick else [pytest.mark.slow])
        for name, case in cases.items()
    ]


ALL = pytest.mark.parametrize("options", slow_but(("complete",), MODELS))


def driven(
    plant: AnalyticalSnake | TwinSnake, duration: float, hz: float
) -> SnakeState:
    """Return the motion of a plant in a turn at 2 Hz, from rest."""
    plant.reset()
    gait = Gait(2.0, 0.2)
    gait.reset(plant.spec, plant.tick)
    return plant.play(gait.script(duration), round(duration * hz))


def free_rates(plant: AnalyticalSnake | TwinSnake, h: SnakeState) -> np.ndarray:
    """Return the rates of the free bends in a motion of `driven`, shape (samples, segments), rad/s."""
    return free_bends(plant, Gait(2.0, 0.2), h.time).bend_rate


def power(plant: AnalyticalSnake | TwinSnake, h: SnakeState) -> np.ndarray:
    """Return Σ T q̇_f, shape (samples,), W."""
    return (h.torque * free_rates(plant, h)).sum(axis=1)


@ALL
@pytest.mark.parametrize(
    ("friction_law", "mu"),
    [
        pytest.param("viscous", {"mu_t": 1.0, "mu_n": 15.0}, marks=pytest.mark.slow),
        pytest.param("axis", {}, marks=pytest.mark.slow),
        ("wheel", {}),
    ],
)
def test_work_is_the_integral_of_the_torque_power(options, friction_law, mu):
    """To second order in the step: the kernels integrate the friction power, not the torque power."""
    spec = robot(**mu)

    def missed(step: float) -> float:
        plant = AnalyticalSnake(
            spec,
            friction=friction_law,
            timestep=step,
            slip_speed=0.01,
            pneumatics=Wave(spec, bias=0.1),
            **options,
        )
        h = driven(plant, 1.0, 1 / step)
        added = cumulative_simpson(np.append(0, power(plant, h)), dx=step, initial=0)[
            1:
        ]
        return np.abs(h.work - added).max() / h.work[-1]

    coarse = missed(5e-4)
    fine = missed(2.5e-4)
    assert fine < 2e-6
    assert np.log2(coarse / fine) == pytest.approx(
        2, abs=0.6
    )  # kinks of the laws scatter it


def kinetic(h: SnakeState, spec: RobotSpec, step: float) -> np.ndarray:
    """Return the energy of the point masses from their positions, shape (samples,), J."""
    velocity = np.gradient(h.position, step, axis=0)
    return (spec.mass.array()[:, None] * velocity**2).sum(axis=(1, 2)) / 2


def stored(plant: AnalyticalSnake, h: SnakeState) -> np.ndarray:
    """Return the elastic energy of compliant segments, shape (samples,), J; 0 for prescribed bends."""
    deviation = h.bend - free_bends(plant, Gait(2.0, 0.2), h.time).bend
    return plant.spec.bending.stiffness * (deviation**2).sum(axis=1) / 2


@pytest.mark.parametrize(
    "friction_law",
    [
        pytest.param("axis", marks=pytest.mark.slow),
        "wheel",
        pytest.param("ellipse", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize(
    "options", [each for each in slow_but(("complete",), MODELS) if each.id != "lumped"]
)
def test_friction_only_dissipates(options, friction_law):
    """Work minus kinetic energy never decreases."""
    spec = robot()
    step = 2e-4
    plant = AnalyticalSnake(
        spec, friction=friction_law, timestep=step, supply_pa=SUPPLY, **options
    )
    h = driven(plant, 1.0, 1 / step)
    taken = h.work - kinetic(h, spec, step) - stored(plant, h)
    # Differences of places do not see where a valve's switch puts a kink into the
    # velocities.
    keep = np.ones(len(taken), dtype=bool)
    switches = np.flatnonzero((h.valves[1:] != h.valves[:-1]).any(axis=(1, 2)))
    for k in [0, len(taken), *switches]:
        keep[max(k - 4, 0) : k + 5] = False
    assert np.diff(taken[keep]).min() > 0
    assert taken[keep][-1] > 0.05


@pytest.mark.parametrize(
    "name",
    [
        "complete",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("simplified", "compliant")
        ),
    ],
)
def test_mean_gait_power_equals_friction_power(name):
    """Over whole periods, the metric is the power of the floor forces plus that of the dampers."""
    plant = AnalyticalSnake(robot(), supply_pa=SUPPLY, timestep=5e-4, **MODELS[name])
    metrics = plant_metrics(rollout(plant, Gait(2.0, 0.2), 4.0))
    h = driven(plant, 4.0, 2000)
    step = 5e-4
    velocity = np.gradient(h.position, step, axis=0)
    deviation = h.bend_rate - free_rates(plant, h)
    power = (
        plant.spec.bending.damping * (deviation**2).sum(axis=1) * (name == "compliant")
    )
    taken = (power - (h.contact_force * velocity).sum(axis=(1, 2)))[h.time > 1.0].mean()
    assert metrics["mechanical_power_w"] == pytest.approx(taken, rel=0.005)
    weight = plant.spec.mass.total * 9.81
    speed = metrics["com_speed_m_s"]
    assert metrics["cost_of_transport"] == pytest.approx(
        taken / (weight * speed), rel=0.005
    )
    # Every connector travels at least as far as the snake, against at least the drag of
    # its wheels.
    assert metrics["cost_of_transport"] > plant.spec.friction.mu_t


def test_yaw_power_counts_without_friction_torque():
    """The omitted moment does no work: it neither rotates the body nor dissipates."""
    spec = robot()
    step = 2e-4
    plant = AnalyticalSnake(
        spec,
        timestep=step,
        slip_speed=0.01,
        pneumatics=Wave(spec, bias=0.1),
        **MODELS["no torque"],
    )
    h = driven(plant, 1.0, 1 / step)
    velocity = np.gradient(h.position, step, axis=0)
    yaw_rate = np.gradient(h.heading, step)
    arm = h.position - h.com[:, None]
    moment = (
        arm[..., 0] * h.contact_force[..., 1] - arm[..., 1] * h.contact_force[..., 0]
    ).sum(axis=1)
    floor_power = (h.contact_force * velocity).sum(axis=(1, 2)) - moment * yaw_rate
    change = np.gradient(kinetic(h, spec, step), step)
    inside = slice(5, -5)
    assert (power(plant, h) + floor_power)[inside] == pytest.approx(
        change[inside], abs=2e-3 * np.abs(change).max()
    )
    assert np.abs(moment * yaw_rate).max() > 0.1 * np.abs(change).max()


# The twin

CONTACTS = pytest.mark.parametrize("contact", ["preloaded", "loaded"])


def in_springs_and_dampers(
    plant: TwinSnake, h: SnakeState, qvel: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return energy stored (J) and power dissipated (W) in the two hinges of each segment.

    Hinges of stiffness 2k and damping 2c deviate from their shares q_f/2 of the free
    bends.
    """
    model = plant.physics.model
    bending = plant.spec.bending
    rates = free_rates(plant, h)
    free = cumulative_simpson(rates, dx=float(h.time[1] - h.time[0]), axis=0, initial=0)
    stored = lost = 0.0
    for k in (1, 2):
        joints = [model.joint(f"hinge_{j + 1}_{k}") for j in range(plant.spec.segments)]
        angle = h.qpos[:, [item.qposadr[0] for item in joints]] - free / 2
        rate = qvel[:, [item.dofadr[0] for item in joints]] - rates / 2
        stored = stored + bending.stiffness * (angle**2).sum(axis=1)
        lost = lost + 2 * bending.damping * (rate**2).sum(axis=1)
    return stored, lost


def conserved(plant: TwinSnake, h: SnakeState) -> tuple[np.ndarray, float, float]:
    """Return ∫ Σ T dq_f at each sample, the final energy of body and springs, and the internal loss, J.

    All follow from recorded columns; differences of the positions at the ends of steps
    are the velocities.
    """
    step = plant.timestep
    model = plant.physics.model
    qvel = np.zeros((len(h.time), model.nv))
    inertia = np.zeros((model.nv, model.nv))
    for k in range(1, len(qvel)):
        mujoco.mj_differentiatePos(model, qvel[k], step, h.qpos[k - 1], h.qpos[k])
    stored, lost = in_springs_and_dampers(plant, h, qvel)
    data = mujoco.MjData(model)
    data.qpos[:] = (h.qpos[-1] + h.qpos[-2]) / 2
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    return (
        cumulative_trapezoid(power(plant, h), h.time, initial=0.0),
        float(qvel[-1] @ inertia @ qvel[-1] / 2 + stored[-1]),
        step * lost.sum(),
    )


def test_energy_of_a_clamped_twin_is_conserved():
    """To first order in the step, like the engine: extrapolated from two time steps."""
    spec = robot()

    def missed(step: float) -> float:
        plant = TwinSnake(spec, timestep=step, supply_pa=SUPPLY, base="clamped")
        work, kept, lost = conserved(plant, driven(plant, 0.2, 1 / step))
        assert lost > 0.02 * work[-1]
        return (kept + lost) / work[-1] - 1

    coarse = missed(2.5e-4)
    fine = missed(1.25e-4)
    assert 2 * fine - coarse == pytest.approx(0, abs=1e-3)


@CONTACTS
def test_energy_of_a_twin_on_the_floor_is_conserved(contact):
    """∫ T dq_f is kinetic energy, energy of springs, and the losses of hinges and floor."""
    plant = TwinSnake(robot(), contact=contact, timestep=2.5e-4, supply_pa=SUPPLY)
    h = driven(plant, 1.5, 1 / plant.timestep)
    assert h.work[0] == pytest.approx(0.0, abs=1e-3)
    work, kept, lost = conserved(plant, h)
    velocity = np.gradient(h.position, plant.timestep, axis=0)
    friction = -plant.timestep * (h.contact_force * velocity).sum()
    # Recorded forces are sums over a connector's wheels, without the moment that brakes
    # its turning.
    assert kept + lost + friction == pytest.approx(work[-1], rel=0.03)
    assert h.internal_loss[-1] == pytest.approx(
        lost, rel=0.02
    )  # pitch and roll hardly move
    assert lost > 0.03 * work[-1]
    # The recorded work converges to first order in the step for the preloaded contact,
    # to second order for the loaded one.
    begin = round(0.5 / plant.timestep)
    assert h.work[-1] - h.work[begin] == pytest.approx(
        work[-1] - work[begin], rel={"loaded": 5e-4, "preloaded": 7e-3}[contact]
    )


def test_twin_power_equals_that_of_the_compliant_model():
    """Stiff bends deliver the power of `complete`; shipped ones oscillate and take more than twice of it."""

    def powers(plant: AnalyticalSnake | TwinSnake) -> tuple[float, float]:
        metrics = plant_metrics(rollout(plant, Gait(2.0), 5.0))
        return metrics["mechanical_power_w"], metrics["internal_power_w"] or 0.0

    options = {"supply_pa": SUPPLY, "friction": "wheel"}
    stiff, inside = powers(TwinSnake(robot(stiffness=20.0), supply_pa=SUPPLY))
    shipped, _ = powers(TwinSnake(robot(), supply_pa=SUPPLY))
    complete, _ = powers(AnalyticalSnake(robot(), **options))
    compliant, _ = powers(
        AnalyticalSnake(robot(), model="compliant", inertia="connector", **options)
    )
    # The material of stiff segments dissipates, too: c grows with k.
    assert stiff - inside == pytest.approx(complete, rel=0.05)
    assert shipped == pytest.approx(compliant, rel=0.05)
    assert compliant > 2 * complete


def test_twin_torques_are_consistent_with_its_work_under_drag():
    """With smooth bends; with kinks or stiff bends the recorded torques are of first order in the step."""
    spec = robot(drag=0.08)
    chambers = Wave(spec, bias=0.1, rise=0.4)
    plant = TwinSnake(spec, timestep=0.001, pneumatics=chambers)
    h = driven(plant, 1.5, 1000)
    begin = h.time > 0.25
    work = 0.001 * power(plant, h)[begin].sum()
    assert work == pytest.approx(h.work[-1] - h.work[begin][0], rel=0.02)
