"""Runs on a Warp device compared with the CPU engine; here Warp runs on the CPU, too."""

from __future__ import annotations

import copy
import pickle
import sys
from dataclasses import replace
from itertools import product
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import srs_twin.envs  # noqa: F401
from srs_twin import Gait, InputError, TwinBatch, TwinSnake, load_robot, run_scripts
from srs_twin.compute.workers import TaskResult
from srs_twin.errors import EngineWarning
from srs_twin.pneumatics import LagPneumatics
from srs_twin.pneumatics.valves import StuckValve
from srs_twin.robot.world import Circle, Floor, World
from srs_twin.studies.sweep.execution import local, on_device
from srs_twin.studies.sweep.loading import load_sweep

wp = pytest.importorskip("warp", reason="the extra gpu is not installed")
GEN2 = load_robot("gen2")
ON = {"engine": "warp", "device": "cpu"}
SOFT = replace(
    GEN2, bending=replace(GEN2.bending, stiffness=0.7 * GEN2.bending.stiffness)
)
SLICK = replace(GEN2, friction=replace(GEN2.friction, mu_n=0.5 * GEN2.friction.mu_n))
STRONG = replace(GEN2, actuator=replace(GEN2.actuator, gain=1.2 * GEN2.actuator.gain))
HEAVY = replace(
    GEN2,
    mass=replace(GEN2.mass, connectors=tuple(1.3 * m for m in GEN2.mass.connectors)),
)


@pytest.fixture(params=["preloaded", "loaded"])
def contact(request):
    return request.param


def both(specs, gaits, seconds, **settings):
    """Return the trajectories of the CPU engine and of the device."""
    result = []
    for more in ({}, ON):
        batch = TwinBatch(specs, **settings, **more)
        result.append(run_scripts(batch, [Gait(*item) for item in gaits], seconds))
    return result


def compiled(twin, settings, air=None):
    """Return the device kernels of a twin, and a function that puts records of a kind on the device.

    Args:
        twin: twin with the chambers and sensors of the records.
        settings: values of `StepSettings`.
        air: state of the chambers; None for empty chambers.
    """
    from srs_twin.warp import kernels
    from srs_twin.warp.translation import stack_records, warp_struct

    empty = np.zeros((twin.spec.segments, 2))
    whole = empty.astype(int)
    at_rest = kernels.ChamberState(empty, *[empty[:, 0]] * 3, whole, whole, empty[:, 0])
    records = {
        "relaxation": twin.pneumatics.relaxation(settings["slot"]),
        "addresses": twin.physics.sensor_addresses,
        "chambers": air or at_rest,
        "accumulators": kernels.Accumulators(empty[0], *3 * [empty]),
        "wave": kernels.GaitWave(1.0, 0.0, 0.0, empty[:, 0]),
        "bodies": kernels.BodyViews(*7 * [empty]),
    }
    ported = {name: warp_struct(record) for name, record in records.items()}
    built = kernels.build_kernels(ported, kernels.StepSettings(tick=1, **settings))

    def on_the_device(name, values=None):
        return stack_records(ported[name], values or [records[name]], "cpu")

    return built, on_the_device


def waves(gaits, slot, slots, steps):
    """Return the valve states that the device computes for gaits, shape (gaits, slots, segments, 2)."""
    from srs_twin.warp.kernels import GaitWave

    settings = {"h": slots * slot, "slot": slot, "slots": slots, "mean_control": False}
    built, on_the_device = compiled(TwinSnake(GEN2), settings)
    records = on_the_device(
        "wave",
        [GaitWave(g.frequency, g.offset, g.rest_level, g.phase_lag) for g in gaits],
    )
    out = wp.zeros((len(gaits), slots, GEN2.segments, 2), dtype=int, device="cpu")
    actual = []
    for step in range(steps):
        count = wp.full(1, step, dtype=int, device="cpu")
        wp.launch(
            built.set_gait,
            dim=(len(gaits), GEN2.segments),
            inputs=[count, records, out],
            device="cpu",
        )
        actual.append(out.numpy().copy())
    return np.concatenate(actual, axis=1)


def test_device_gait_switches_valves_at_the_schedule_slots():
    """No valve edge of these gaits is within single-precision rounding of the middle of a slot."""
    gaits = [
        Gait(1.37, 0.11),
        Gait(2.9, -0.43, phase=0.7),
        Gait(0.83, 0.27, phases=(0.1, 0.5, 0.2, 0.9)),
        Gait(1.7, 0.09, rest_fraction=0.3),
        Gait(2.3, -0.31, phase_step=0.6, rest_fraction=0.1),
    ]
    for gait in gaits:
        gait.reset(GEN2, 0.02)
    slot = 1e-4
    slots = 2000
    steps = 6
    there = waves(gaits, slot, slots, steps)
    for gait, values in zip(gaits, there, strict=True):
        schedule = gait.script(slot * slots * steps)
        at = (
            np.searchsorted(
                schedule.starts, slot * (np.arange(slots * steps) + 0.5), side="right"
            )
            - 1
        )
        assert len(schedule.starts) > 8
        assert (values == schedule.states[at]).all()


@pytest.mark.slow
def test_device_controls_equal_those_of_the_processor():
    """The bends of these segments saturate, and their damping time differs from the mode time constant."""
    from srs_twin.warp.kernels import ChamberState

    damped = replace(GEN2, bending=replace(GEN2.bending, damping_time=8e-3))
    bent = replace(damped, actuator=replace(GEN2.actuator, bend_limit=0.6))
    twin = TwinSnake(bent)
    h = 1e-4
    valves = np.array([[1, -1], [-1, 1], [1, 1], [-1, -1]])
    chambers = twin.pneumatics
    chambers.advance(
        chambers.schedule(np.array([-valves, valves]), 0.2), np.array([0.2])
    )
    state = chambers.pressure.copy(), chambers._linear.copy(), chambers.bend.copy()
    trace = chambers.advance(chambers.schedule(valves, h), np.array([0.0, h]))
    whole = np.zeros((bent.segments, 2), dtype=int)
    air = ChamberState(
        *state, trace.bend_rate[0], whole, whole, np.zeros(bent.segments)
    )
    settings = {"h": h, "slot": h, "slots": 1, "mean_control": True}
    built, on_the_device = compiled(twin, settings, air)
    ctrl = wp.zeros((1, 2 * bent.segments), dtype=float, device="cpu")
    wp.launch(
        built.advance_chambers,
        dim=(1, bent.segments),
        inputs=[
            on_the_device("relaxation"),
            on_the_device("chambers"),
            wp.array(valves[None, None], dtype=int, device="cpu"),
            ctrl,
        ],
        device="cpu",
    )
    expected = twin.physics.controls(trace).mean(axis=0)
    assert ctrl.numpy()[0] == pytest.approx(expected, rel=1e-4, abs=1.0)


@pytest.mark.slow
def test_runs_agree_with_the_cpu_engine(contact):
    points = list(
        product((1.0, 1.5, 2.0), (41e3, 48e3, 55e3), (0.0, 0.0085), (0.0, 0.2))
    )
    specs = [
        replace(GEN2, geometry=replace(GEN2.geometry, rigid_gap=gap))
        for _, _, gap, _ in points
    ]
    gaits = [(f, offset) for f, _, _, offset in points]
    here, there = both(
        specs, gaits, 0.3, contact=contact, supply_pa=[p for _, p, _, _ in points]
    )
    for a, b in zip(here, there, strict=True):
        assert np.abs(a.stack("bend") - b.stack("bend")).max() < 1e-3
        assert np.abs(a.position - b.position).max() < 5e-4
        assert np.abs(a["work"] - b["work"]).max() < 1e-4
        assert np.abs(a["internal_loss"] - b["internal_loss"]).max() < 1e-5
        assert b["pneumatic_energy"] == pytest.approx(
            a["pneumatic_energy"], rel=1e-3, abs=1e-3
        )
        assert a.metadata["valve_switches"] == b.metadata["valve_switches"]


@pytest.mark.slow
def test_each_world_has_individual_parameters(contact):
    specs = [GEN2, SOFT, SLICK, STRONG, HEAVY]
    here, there = both(specs, [(2.0, 0.2)] * 5, 0.3, contact=contact)
    ends = np.array([run.com[-1] for run in there])
    assert min(np.hypot(*(ends[0] - end)) for end in ends[1:]) > 1e-4  # they act
    for a, b in zip(here, there, strict=True):
        assert np.linalg.norm(a.com - b.com, axis=1).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("friction_law", ["cosine", "ellipse"])
def test_skin_agrees_with_the_cpu_engine(friction_law, capfd):
    base = load_robot("skin_example")
    spec = replace(base, skin=replace(base.skin, friction_law=friction_law))
    other = replace(spec, friction=replace(spec.friction, mu_back=0.2, mu_n=0.3))
    here, there = both([spec, other], [(1.0, 0.0), (1.0, 0.2)], 0.1)
    assert (
        "overflow" not in capfd.readouterr().out
    )  # too little room for contacts loses forces
    for a, b in zip(here, there, strict=True):
        assert a["work"][-1] > 0.005
        assert np.linalg.norm(a.com - b.com, axis=1).max() < 1e-5
        assert np.abs(a["work"] - b["work"]).max() < 1e-5
        assert np.abs(a["internal_loss"] - b["internal_loss"]).max() < 1e-6


@pytest.mark.slow
def test_obstacle_contact_agrees_with_the_cpu_engine():
    world = World((Circle(0.24, 0.03, 0.04),))
    here, there = both([GEN2], [(2.0, 0.0)], 0.8, contact="loaded", world=world)
    force = [
        np.hypot(run[0]["obstacle_force_x_1"], run[0]["obstacle_force_y_1"]).max()
        for run in (here, there)
    ]
    assert force[0] > 0.5 and force[1] == pytest.approx(force[0], rel=0.01)


@pytest.mark.slow
def test_partial_reset_empties_the_chambers_of_chosen_worlds():
    batch = TwinBatch([GEN2] * 2, **ON)
    batch.arrays()["pressure"].fill_(48e3)
    batch.reset(worlds=[1])
    assert batch.arrays()["pressure"].numpy().reshape(2, -1).max(axis=1).tolist() == [
        pytest.approx(48e3),
        0,
    ]
    batch.reset()
    assert not batch.arrays()["pressure"].numpy().any() and not batch.openings().any()


def displaced(place, steps=60):
    """Return the motion of a turning snake relative to its start, and the mean position of its states."""
    batch = TwinBatch([GEN2] * 2, deterministic=True, **ON)
    batch.set_gaits([Gait(2.0, 0.4)] * 2)
    batch.reset(poses=[(*place, 0.3), (0.0, 0.0, 0.3)])
    return [
        state.com - state.com[0] for state in batch.follow(steps * 1e-3 * 4, 4)
    ], batch


@pytest.mark.slow
def test_distant_start_moves_like_one_at_the_origin():
    place = (2000.0, -700.0)
    (far, near), batch = displaced(place)
    # The device computes both near zero; adding the start rounds in double precision.
    assert np.abs(far - near).max() < 1e-9
    assert batch.state.com[0] == pytest.approx(place, abs=0.5)
    assert batch.state.position[0].mean(axis=0) == pytest.approx(place, abs=0.5)
    assert batch.state.qpos[0, :2] == pytest.approx(place, abs=0.5)
    batch.reset(worlds=[0])
    assert np.abs(batch.state.com).max() < 0.5


@pytest.mark.slow
def test_distant_start_with_obstacles_raises():
    batch = TwinBatch(
        [GEN2], world=World((Circle(1.0, 0.0, 0.1),)), contact="loaded", **ON
    )
    batch.reset(poses=[(15.9, 0.0, 0.0)])
    with pytest.raises(
        InputError, match=r"run 0 starts at \(2000, 0\) m.* within 16 m of the origin"
    ):
        batch.reset(poses=[(2000.0, 0.0, 0.0)])


@pytest.mark.slow
def test_repeated_batch_is_equal_and_exposes_its_arrays(contact):
    batch = TwinBatch([GEN2] * 3, contact=contact, deterministic=True, **ON)
    batch.set_gaits([Gait(2.0), Gait(2.0), Gait(2.0, 0.6)])
    first = batch.follow(0.1, 10)
    assert (first[0].qpos == first[1].qpos).all() and (
        first[0].qpos != first[2].qpos
    ).any()
    assert np.from_dlpack(batch.arrays()["qpos"]).shape == (3, first[0].qpos.shape[1])
    batch.reset(worlds=[1], poses=[(1.0, 2.0, 0.5)])
    assert batch.state.com[1] == pytest.approx((1.0, 2.0), abs=1e-6)
    assert batch.state.heading[1] == pytest.approx(0.5, abs=1e-6)
    assert batch.state.time.tolist() == pytest.approx([0.1, 0.0, 0.1])
    assert (batch.state.bend[0] == first[0].bend[-1]).all()
    batch.reset()
    assert (batch.follow(0.1, 10)[2].qpos == first[2].qpos).all()
    reported = np.tile([[1, -1], [-1, 1]], (3, 2, 1))
    batch.step(wp.array(reported, dtype=wp.int32, device="cpu"))
    assert (batch.state.valves == reported).all()
    with pytest.raises(InputError, match="int32, not int64"):
        batch.step(wp.array(reported, dtype=wp.int64, device="cpu"))


@pytest.mark.slow
def test_environments_agree_with_the_cpu_engine():
    made = [
        gymnasium.make_vec(
            "srs_twin.envs:SRSTwin/GoTo-v0", num_envs=2, limit_s=0.3, **more
        )
        for more in ({}, ON)
    ]
    seen = [env.reset(seed=3)[0] for env in made]
    assert (seen[0] == seen[1]).all()
    rng = np.random.default_rng(0)
    for _ in range(6):  # an episode, and the beginning of another
        action = rng.uniform(
            made[0].action_space.low, made[0].action_space.high
        ).astype(np.float32)
        here, there = (env.step(action) for env in made)
        assert (
            np.abs(here[0] - there[0]).max() < 1e-3
            and np.abs(here[1] - there[1]).max() < 1e-4
        )
        assert (here[3] == there[3]).all()
    with pytest.warns(
        EngineWarning, match="the episodes have different robots or obstacles"
    ):
        gymnasium.make_vec(
            "srs_twin.envs:SRSTwin/Obstacles-v0", num_envs=1, **ON
        ).reset(seed=1)


@pytest.mark.slow
def test_unobserved_steps_count_and_diverged_run_ends_alone():
    batch, here = (TwinBatch([GEN2] * 2, contact="loaded", **more) for more in (ON, {}))
    batch.set_gaits([Gait(2.0)] * 2)
    batch.run(80, gait=True)
    seen = batch.follow(0.02, 1)[0]
    script = Gait(2.0)
    script.reset(GEN2, here.tick)
    there = here.play([script.script(0.1)] * 2, 1)[0]
    assert seen.time == pytest.approx([0.1])
    assert seen.contact_force == pytest.approx(there.contact_force, abs=1e-3)
    broken = batch.arrays()["qvel"].numpy()
    broken[1] = np.nan
    batch.arrays()["qvel"].assign(broken)
    sound, ended = batch.follow(0.02, 2)
    assert (
        ended is None and batch.errors[0] is None and "finite" in str(batch.errors[1])
    )
    assert np.isfinite(batch.state.com).all() and np.isfinite(sound.com).all()
    with pytest.raises(InputError, match="1 values are given for 2"):
        batch.set_gaits([Gait(2.0)])


SWEEP = """
scenario: gen2_straight
fixed: {duration_s: 2.0}
vary: {controller.frequency_hz: [2.0, 2.5], pneumatics.kind: [lag, orifice]}
plants: [twin]
"""


@pytest.mark.slow
def test_sweep_agrees_with_the_cpu_engine(tmp_path):
    (tmp_path / "s.yaml").write_text(SWEEP)
    found = load_sweep(tmp_path / "s.yaml")
    here = {row.number: row.result for row in local(1)(found.experiment, found.points)}
    with pytest.warns(EngineWarning, match="2 of 4 points run on the CPU: .*'orifice'"):
        there = {
            row.number: row.result
            for row in on_device("cpu", 1)(found.experiment, found.points)
        }
    for number, row in here.items():
        for name in ("com_speed_m_s", "mean_bend_amplitude_rad", "pneumatic_power_w"):
            assert there[number].values[f"twin.{name}"] == pytest.approx(
                row.values[f"twin.{name}"], rel=5e-3
            )


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"pneumatics": "orifice"}, "pneumatics 'orifice'"),
        ({"base": "clamped"}, "base 'clamped'"),
        ({"layout": "in_out"}, "layout 'in_out'"),
        (
            {"world": World((Circle(1.0, 0.0, 0.1),)), "contact": "preloaded"},
            "obstacles with contact 'preloaded'",
        ),
    ],
)
def test_unsupported_settings_raise_by_name(settings, named):
    with pytest.raises(InputError, match=named):
        TwinBatch([GEN2], **settings, **ON)


def test_unsupported_twins_raise_by_name():
    from srs_twin.warp.batch import WarpBatch

    WarpBatch.check(TwinSnake(GEN2))
    twins = {"floor that slopes": TwinSnake(GEN2, world=World(floor=Floor(0.1, 0.0)))}
    for name in ("leak_per_s", "valve_delay_s"):
        chambers = LagPneumatics(GEN2, supply_pa=48e3, **{name: 0.5})
        twins[name] = TwinSnake(GEN2, pneumatics=chambers)
    twins["stuck valves"] = TwinSnake(GEN2)
    twins["stuck valves"].pneumatics.stuck = (StuckValve(1, 0, 1),)
    for name, twin in twins.items():
        with pytest.raises(InputError, match=f"does not support .*{name}"):
            WarpBatch.check(twin)


def test_start_poses_rotate_and_shift_the_root():
    """The start adds a yaw to the orientation and lifts the snake by 10 nm."""
    from srs_twin.warp.batch import _moved

    rng = np.random.default_rng(0)
    turns = Rotation.random(3, rng=rng)
    qpos = np.hstack([rng.normal(size=(3, 3)), turns.as_quat(scalar_first=True)])
    places = rng.normal(size=(3, 3))
    yaw = Rotation.from_euler("z", places[:, 2:])
    moved = _moved(qpos, places)
    assert moved[:, :3] == pytest.approx(
        yaw.apply(qpos[:, :3]) + np.column_stack([places[:, :2], np.full(3, 1e-8)]),
        abs=1e-12,
    )
    both = (yaw * turns).as_quat(scalar_first=True)
    signs = np.sign((moved[:, 3:] * both).sum(axis=1, keepdims=True))
    assert moved[:, 3:] == pytest.approx(signs * both)


@pytest.mark.parametrize("copy_of", [pickle.dumps, copy.deepcopy, copy.copy])
def test_copying_a_warp_batch_raises(copy_of):
    from srs_twin.warp.batch import WarpBatch

    with pytest.raises(
        InputError, match=r"neither copied nor pickled; .*`save\(\)` and `restore\(\)`"
    ):
        copy_of(object.__new__(WarpBatch))


def test_unsupported_sweep_points_run_once_on_the_cpu(tmp_path, monkeypatch):
    def refuse(twin: TwinSnake) -> None:
        raise InputError("it cannot")

    def here(workers):
        return lambda experiment, points: (
            TaskResult(k, each.changes, None) for k, each in enumerate(points)
        )

    kind = SimpleNamespace(accelerated=lambda: True, check=refuse)
    for name, value in {"warp_batch": lambda: kind, "local": here}.items():
        monkeypatch.setattr(f"srs_twin.studies.sweep.execution.{name}", value)
    (tmp_path / "s.yaml").write_text(
        SWEEP.replace("[2.0, 2.5]", "[2.0]").replace("[lag, orifice]", "[lag]")
    )
    found = load_sweep(tmp_path / "s.yaml")
    points = [replace(found.points[0], changes={"seed": seed}) for seed in range(5)]
    with pytest.warns(EngineWarning, match="5 of 5 points run on the CPU: it cannot"):
        rows = list(on_device(None, 1)(found.experiment, points))
    assert [(row.number, row.result) for row in rows] == [
        (k, {"seed": k}) for k in range(5)
    ]


@pytest.mark.parametrize("max_worlds", [1, 2, 100])
def test_sweep_batches_fit_into_memory_and_share_twins(
    tmp_path, monkeypatch, max_worlds
):
    batches = []

    class Batch:
        accelerated = staticmethod(lambda: True)
        check = staticmethod(lambda twin: None)
        max_worlds = staticmethod(lambda *_: max_worlds_of_device)

        def __init__(self, twins, device):
            batches.append(twins)

    max_worlds_of_device = max_worlds
    module = "srs_twin.studies.sweep.execution"
    monkeypatch.setattr(f"{module}.warp_batch", lambda: Batch)
    monkeypatch.setattr(f"{module}.run_scripts", lambda batch, *_, **__: batches[-1])
    monkeypatch.setattr(f"{module}.run_point", lambda _, point, runs: runs["twin"])
    sweep = SWEEP.replace("pneumatics.kind", "robot")
    (tmp_path / "s.yaml").write_text(sweep.replace("[lag, orifice]", "[gen2, gen3]"))
    found = load_sweep(tmp_path / "s.yaml")
    rows = list(on_device(None, 1)(found.experiment, found.points))
    assert [row.number for row in rows] == [0, 1, 2, 3]
    assert max(map(len, batches)) == min(max_worlds, 4)
    for row, point in zip(rows, found.points, strict=True):
        assert row.result.spec.name == point.changes["robot"]
    if max_worlds == 100:
        assert len(set(map(id, batches[0]))) == 2


def test_number_of_worlds_follows_from_the_free_memory(monkeypatch):
    from srs_twin.warp.batch import WarpBatch

    twin = TwinSnake(GEN2)
    free = wp.get_device("cpu").free_memory
    short = WarpBatch.max_worlds(twin, 1, "cpu")
    assert WarpBatch.max_worlds(twin, 100_000, "cpu") < short / 10
    # The twin alone takes 3 MB of half of the free memory.
    assert 1 < short < free / 2 / 3e6 * 1.5


def test_sweep_without_gpu_warns_and_runs_on_the_cpu(monkeypatch):
    from srs_twin.warp.batch import WarpBatch

    monkeypatch.setattr(WarpBatch, "accelerated", staticmethod(lambda: False))
    with pytest.warns(EngineWarning, match="no accelerator"):
        assert "on_device" not in on_device(None, 1).__qualname__


def test_missing_warp_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "srs_twin.warp.batch", None)
    with pytest.raises(InputError, match=r"srs-twin\[gpu\]"):
        TwinBatch([GEN2], engine="warp")


@pytest.mark.slow
@pytest.mark.gpu
def test_gpu_speed_agrees_with_the_cpu_engine(contact):
    if not wp.get_preferred_device().is_cuda:
        pytest.skip("there is no accelerator here")
    found = [
        run_scripts(
            TwinBatch([GEN2] * 2, contact=contact, engine=engine),
            [Gait(2.0), Gait(2.0, 0.2)],
            10.0,
        )
        for engine in ("cpu", "warp")
    ]
    for a, b in zip(*found, strict=True):
        distances = [np.hypot(*(run.com[-1] - run.com[400])) for run in (a, b)]
        assert distances[1] == pytest.approx(distances[0], rel=5e-3)
