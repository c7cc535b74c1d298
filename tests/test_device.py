"""Twins on a device against those of the processor, world by world; here Warp steps on the processor, too."""

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

import srs_twin.envs  # noqa: F401
from srs_twin import Gait, InputError, TwinBatch, TwinSnake, load_robot, run_scripts
from srs_twin.compute.workers import Done
from srs_twin.errors import EngineWarning
from srs_twin.plants.twin.friction_held import held, rolling
from srs_twin.pneumatics.chambers import as_felt
from srs_twin.robot.world import Circle, World
from srs_twin.studies.sweep.execution import local
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.on_device import on_device

wp = pytest.importorskip("warp", reason="the extra gpu is not installed")
GEN2 = load_robot("gen2")
ON = {"engine": "warp", "device": "cpu"}
SOFT = replace(GEN2, bending=replace(GEN2.bending, stiffness=0.7 * GEN2.bending.stiffness))
SLICK = replace(GEN2, friction=replace(GEN2.friction, mu_n=0.5 * GEN2.friction.mu_n))
STRONG = replace(GEN2, actuator=replace(GEN2.actuator, gain=1.2 * GEN2.actuator.gain))
HEAVY = replace(GEN2, mass=replace(GEN2.mass, connectors=tuple(1.3 * m for m in GEN2.mass.connectors)))


@pytest.fixture(params=["preloaded", "loaded"])
def contact(request):
    return request.param


def both(specs, gaits, seconds, **settings):
    """Return the trajectories of the processor and of the device."""
    found = []
    for more in ({}, ON):
        batch = TwinBatch(specs, **settings, **more)
        found.append(run_scripts(batch, [Gait(*each) for each in gaits], seconds))
    return found


def test_the_laws_of_friction_are_the_same_in_warp():
    from srs_twin.warp.ported import ported

    laws = ported([held, rolling])
    wheel = laws["rolling"]

    @wp.kernel(enable_backward=False)
    def each(given: wp.array2d(dtype=float), out: wp.array2d(dtype=float)):
        i = wp.tid()
        a, b, c, d, e, f = wheel(
            given[i, 0], given[i, 1], given[i, 2], given[i, 3], given[i, 4], 0.001, given[i, 5], given[i, 6],
            given[i, 7], given[i, 8],
        )  # fmt: skip
        out[i, 0] = a
        out[i, 1] = b
        out[i, 2] = c
        out[i, 3] = d
        out[i, 4] = e
        out[i, 5] = f

    rng = np.random.default_rng(3)
    speed, load = rng.normal(scale=0.1, size=(200, 2)), rng.uniform(0, 1, size=(200, 1))
    mu = np.sort(rng.uniform(0.01, 0.5, size=(200, 2)), axis=1)
    push = rng.normal(scale=0.05, size=(200, 2))
    given = np.hstack(
        [speed, load, mu, push, rng.normal(scale=0.1, size=(200, 1)), rng.uniform(0.1, 9, (200, 1))]
    )
    out = wp.zeros((200, 6), dtype=float, device="cpu")
    wp.launch(each, dim=200, inputs=[wp.array(given, dtype=float, device="cpu"), out], device="cpu")
    here = np.array([rolling(*row[:5], 0.001, *row[5:]) for row in given])
    scale = np.abs(here).max(axis=0)
    assert np.abs(out.numpy() - here).max(axis=0) == pytest.approx(0 * scale, abs=1e-3 * scale.max())
    assert np.abs(out.numpy() - here)[:, :2].max() < 1e-5


def waves(gaits, slot, slots, steps):
    """Return the valves that the device computes for gaits, shape (gaits, slots, segments, 2)."""
    from srs_twin.warp.kernels import Air, Bodies, Kept, Wave, kernels
    from srs_twin.warp.ported import record, stacked

    twin, empty = TwinSnake(GEN2), np.zeros((GEN2.segments, 2))
    whole = empty.astype(int)
    records = {
        "relaxation": twin.pneumatics.relaxation(slot), "columns": twin.physics.columns,
        "air": Air(empty, empty[:, 0], whole, whole, empty[:, 0]), "kept": Kept(empty[0], *3 * [empty]),
        "wave": Wave(1.0, 0.0, 0.0, empty[:, 0]), "bodies": Bodies(*7 * [empty]),
    }  # fmt: skip
    ported = {name: record(each) for name, each in records.items()}
    spec = SimpleNamespace(h=slots * slot, slot=slot, slots=slots, tick=1, middle=False)
    kernel, found = kernels(ported, spec).wave, []
    given = stacked(ported["wave"], [Wave(g.frequency, g.offset, g.rest, g.lag) for g in gaits], "cpu")
    out = wp.zeros((len(gaits), slots, GEN2.segments, 2), dtype=int, device="cpu")
    for step in range(steps):
        count = wp.full(1, step, dtype=int, device="cpu")
        wp.launch(kernel, dim=(len(gaits), GEN2.segments), inputs=[count, given, out], device="cpu")
        found.append(out.numpy().copy())
    return np.concatenate(found, axis=1)


def test_device_gait_switches_valves_in_the_slots_of_its_schedule():
    """No edge of these gaits is within single-precision rounding of the middle of a slot."""
    gaits = [
        Gait(1.37, 0.11), Gait(2.9, -0.43, phase=0.7), Gait(0.83, 0.27, phases=(0.1, 0.5, 0.2, 0.9)),
        Gait(1.7, 0.09, rest_share=0.3), Gait(2.3, -0.31, phase_step=0.6, rest_share=0.1),
    ]  # fmt: skip
    for gait in gaits:
        gait.reset(GEN2, 0.02)
    slot, slots, steps = 1e-4, 2000, 6
    there = waves(gaits, slot, slots, steps)
    for gait, found in zip(gaits, there, strict=True):
        schedule = gait.script(slot * slots * steps)
        at = np.searchsorted(schedule.starts, slot * (np.arange(slots * steps) + 0.5), side="right") - 1
        assert len(schedule.starts) > 8
        assert (found == schedule.states[at]).all()


def test_pressures_on_the_device_act_as_on_the_processor():
    """The bends of these segments saturate. Under equal pressures the law has its slope at rest."""
    from srs_twin.warp.kernels import Air, Bodies, Kept, Wave, kernels
    from srs_twin.warp.ported import record, stacked

    bent = replace(GEN2, actuator=replace(GEN2.actuator, bend_limit=0.6))
    twin, empty = TwinSnake(bent), np.zeros((bent.segments, 2))
    pressure = 1e3 * np.array([[0.0, 0.0], [30.0, 30.0], [45.0, 5.0], [2.0, 40.0]])
    whole = empty.astype(int)
    air = Air(pressure, empty[:, 0], whole, whole, empty[:, 0])
    records = {
        "relaxation": twin.pneumatics.relaxation(1e-4), "columns": twin.physics.columns, "air": air,
        "kept": Kept(empty[0], *3 * [empty]), "wave": Wave(1.0, 0.0, 0.0, empty[:, 0]),
        "bodies": Bodies(*7 * [empty]),
    }  # fmt: skip
    ported = {name: record(each) for name, each in records.items()}
    spec = SimpleNamespace(h=1e-4, slot=1e-4, slots=1, tick=1, middle=False)
    ctrl = wp.zeros((1, 2 * bent.segments), dtype=float, device="cpu")
    given = [stacked(ported[name], [records[name]], "cpu") for name in ("relaxation", "air")]
    valves = wp.zeros((1, 1, bent.segments, 2), dtype=int, device="cpu")
    wp.launch(kernels(ported, spec).fill, dim=(1, bent.segments), inputs=[*given, valves, ctrl], device="cpu")
    assert ctrl.numpy().reshape(-1, 2) == pytest.approx(as_felt(bent, pressure), rel=1e-5)


@pytest.mark.slow
def test_the_points_of_agreement_are_those_of_the_processor(contact):
    points = list(product((1.0, 1.5, 2.0), (41e3, 48e3, 55e3), (0.0, 0.0085), (0.0, 0.2)))
    specs = [replace(GEN2, geometry=replace(GEN2.geometry, rigid_gap=gap)) for _, _, gap, _ in points]
    gaits = [(f, offset) for f, _, _, offset in points]
    here, there = both(specs, gaits, 0.3, contact=contact, supply_pa=[p for _, p, _, _ in points])
    for a, b in zip(here, there, strict=True):
        assert max(np.abs(a[f"bend_{j}"] - b[f"bend_{j}"]).max() for j in range(1, 5)) < 1e-3
        assert max(np.abs(a[f"{c}_{i}"] - b[f"{c}_{i}"]).max() for c in "xy" for i in range(1, 6)) < 5e-4
        assert np.abs(a["work"] - b["work"]).max() < 1e-4
        assert np.abs(a["internal_loss"] - b["internal_loss"]).max() < 1e-5
        assert b["air"] == pytest.approx(a["air"], rel=1e-3, abs=1e-3)
        assert a.metadata["valve_switches"] == b.metadata["valve_switches"]


@pytest.mark.slow
def test_each_world_has_its_own_numbers(contact):
    specs = [GEN2, SOFT, SLICK, STRONG, HEAVY]
    here, there = both(specs, [(2.0, 0.2)] * 5, 0.3, contact=contact)
    ends = np.array([[run["com_x"][-1], run["com_y"][-1]] for run in there])
    assert min(np.hypot(*(ends[0] - end)) for end in ends[1:]) > 1e-4  # they act
    for a, b in zip(here, there, strict=True):
        assert np.hypot(a["com_x"] - b["com_x"], a["com_y"] - b["com_y"]).max() < 1e-4


@pytest.mark.slow
def test_what_runs_into_an_obstacle_is_held_as_on_the_processor():
    world = World((Circle(0.24, 0.03, 0.04),))
    here, there = both([GEN2], [(2.0, 0.0)], 0.8, contact="loaded", world=world)
    force = [
        np.hypot(run[0]["obstacle_force_x_1"], run[0]["obstacle_force_y_1"]).max() for run in (here, there)
    ]
    assert force[0] > 0.5 and force[1] == pytest.approx(force[0], rel=0.01)


def test_a_reset_empties_the_chambers_of_the_chosen_worlds():
    batch = TwinBatch([GEN2] * 2, **ON)
    batch.arrays()["pressure"].fill_(48e3)
    batch.reset(worlds=[1])
    assert batch.arrays()["pressure"].numpy().reshape(2, -1).max(axis=1).tolist() == [pytest.approx(48e3), 0]
    batch.reset()
    assert not batch.arrays()["pressure"].numpy().any() and not batch.openings().any()


def displaced(place, steps=60):
    """Return the motion of a turning snake relative to where it starts, and its states' mean position."""
    batch = TwinBatch([GEN2] * 2, deterministic=True, **ON)
    batch.set_gaits([Gait(2.0, 0.4)] * 2)
    batch.reset(poses=[(*place, 0.3), (0.0, 0.0, 0.3)])
    return [state.com - state.com[0] for state in batch.follow(steps * 1e-3 * 4, 4)], batch


def test_a_start_far_from_the_origin_moves_as_one_at_the_origin():
    place = (2000.0, -700.0)
    (far, near), batch = displaced(place)
    # The device computes both near zero; adding the start rounds in double precision.
    assert np.abs(far - near).max() < 1e-9
    assert batch.state.com[0] == pytest.approx(place, abs=0.5)
    assert batch.state.position[0].mean(axis=0) == pytest.approx(place, abs=0.5)
    assert batch.state.qpos[0, :2] == pytest.approx(place, abs=0.5)
    batch.reset(worlds=[0])
    assert np.abs(batch.state.com).max() < 0.5


def test_a_start_that_is_too_far_for_single_precision_is_refused_beside_obstacles():
    batch = TwinBatch([GEN2], world=World((Circle(1.0, 0.0, 0.1),)), contact="loaded", **ON)
    batch.reset(poses=[(15.9, 0.0, 0.0)])
    with pytest.raises(InputError, match=r"run 0 starts at \(2000, 0\) m.* within 16 m of the origin"):
        batch.reset(poses=[(2000.0, 0.0, 0.0)])


@pytest.mark.slow
def test_a_batch_is_repeated_world_by_world_and_its_arrays_are_handed_out(contact):
    batch = TwinBatch([GEN2] * 3, contact=contact, deterministic=True, **ON)
    batch.set_gaits([Gait(2.0), Gait(2.0), Gait(2.0, 0.6)])
    first = batch.follow(0.1, 10)
    assert (first[0].qpos == first[1].qpos).all() and (first[0].qpos != first[2].qpos).any()
    assert np.from_dlpack(batch.arrays()["qpos"]).shape == (3, first[0].qpos.shape[1])
    batch.reset(worlds=[1], poses=[(1.0, 2.0, 0.5)])
    assert batch.state.com[1] == pytest.approx((1.0, 2.0), abs=1e-6)
    assert batch.state.heading[1] == pytest.approx(0.5, abs=1e-6)
    assert batch.state.time.tolist() == pytest.approx([0.1, 0.0, 0.1])
    assert (batch.state.bend[0] == first[0].bend[-1]).all()
    batch.reset()
    assert (batch.follow(0.1, 10)[2].qpos == first[2].qpos).all()
    told = np.tile([[1, -1], [-1, 1]], (3, 2, 1))
    batch.step(wp.array(told, dtype=wp.int32, device="cpu"))
    assert (batch.state.valves == told).all()
    with pytest.raises(InputError, match="int32, not int64"):
        batch.step(wp.array(told, dtype=wp.int64, device="cpu"))


@pytest.mark.slow
def test_environments_on_a_device_are_those_of_the_processor():
    made = [
        gymnasium.make_vec("srs_twin.envs:SRSTwin/GoTo-v0", num_envs=2, limit_s=0.3, **more)
        for more in ({}, ON)
    ]
    seen = [env.reset(seed=3)[0] for env in made]
    assert (seen[0] == seen[1]).all()
    rng = np.random.default_rng(0)
    for _ in range(6):  # an episode, and the beginning of another
        action = rng.uniform(made[0].action_space.low, made[0].action_space.high).astype(np.float32)
        here, there = (env.step(action) for env in made)
        assert np.abs(here[0] - there[0]).max() < 1e-3 and np.abs(here[1] - there[1]).max() < 1e-4
        assert (here[3] == there[3]).all()
    with pytest.warns(EngineWarning, match="obstacles differ between episodes"):
        gymnasium.make_vec("srs_twin.envs:SRSTwin/Obstacles-v0", num_envs=1, **ON).reset(seed=1)


@pytest.mark.slow
def test_time_and_forces_count_steps_that_nobody_saw_and_a_run_that_diverges_ends_alone():
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
    assert ended is None and batch.errors[0] is None and "finite" in str(batch.errors[1])
    assert np.isfinite(batch.state.com).all() and np.isfinite(sound.com).all()
    with pytest.raises(InputError, match="1 were given for 2"):
        batch.set_gaits([Gait(2.0)])


SWEEP = """
scenario: gen2_straight
fixed: {duration_s: 2.0}
vary: {controller.frequency_hz: [2.0, 2.5], pneumatics.kind: [lag, orifice]}
plants: [twin]
"""


@pytest.mark.slow
def test_a_sweep_on_a_device_says_what_one_on_the_processor_says(tmp_path):
    (tmp_path / "s.yaml").write_text(SWEEP)
    found = load_sweep(tmp_path / "s.yaml")
    here = {row.number: row.result for row in local(1)(found.experiment, found.points)}
    with pytest.warns(EngineWarning, match="2 of 4 points run on the processor: .*'orifice'"):
        there = {row.number: row.result for row in on_device("cpu", 1)(found.experiment, found.points)}
    for number, row in here.items():
        for name in ("com_speed_m_s", "mean_bend_amplitude_rad", "pneumatic_power_w"):
            assert there[number].values[f"twin.{name}"] == pytest.approx(row.values[f"twin.{name}"], rel=5e-3)


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
def test_what_a_device_cannot_do_is_refused_by_its_name(settings, named):
    with pytest.raises(InputError, match=named):
        TwinBatch([GEN2], **settings, **ON)


@pytest.mark.parametrize("way", [pickle.dumps, copy.deepcopy, copy.copy])
def test_copies_of_a_batch_on_a_device_are_refused(way):
    from srs_twin.warp.batch import WarpBatch

    with pytest.raises(InputError, match=r"neither copied nor pickled; .* save\(\) and restore\(\)"):
        way(object.__new__(WarpBatch))


@pytest.mark.parametrize("together", [2, 1024])
def test_every_point_that_no_device_runs_is_run_once_here(tmp_path, monkeypatch, together):
    def refuse(twin: TwinSnake) -> None:
        raise InputError("it cannot")

    def here(workers):
        return lambda experiment, points: (Done(k, each.changes, None) for k, each in enumerate(points))

    kind = SimpleNamespace(accelerated=lambda: True, check=refuse)
    for name, value in {"warp_batch": lambda: kind, "local": here, "TOGETHER": together}.items():
        monkeypatch.setattr(f"srs_twin.studies.sweep.on_device.{name}", value)
    (tmp_path / "s.yaml").write_text(SWEEP.replace("[2.0, 2.5]", "[2.0]").replace("[lag, orifice]", "[lag]"))
    found = load_sweep(tmp_path / "s.yaml")
    points = [replace(found.points[0], changes={"seed": seed}) for seed in range(5)]
    with pytest.warns(EngineWarning, match="5 of 5 points run on the processor: it cannot"):
        rows = list(on_device(None, 1)(found.experiment, points))
    assert [(row.number, row.result) for row in rows] == [(k, {"seed": k}) for k in range(5)]


def test_without_an_accelerator_a_sweep_says_so_and_runs_on_the_processor(monkeypatch):
    from srs_twin.warp.batch import WarpBatch

    monkeypatch.setattr(WarpBatch, "accelerated", staticmethod(lambda: False))
    with pytest.warns(EngineWarning, match="no accelerator"):
        assert "on_device" not in on_device(None, 1).__qualname__


def test_without_warp_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "srs_twin.warp.batch", None)
    with pytest.raises(InputError, match=r"srs-twin\[gpu\]"):
        TwinBatch([GEN2], engine="warp")


@pytest.mark.slow
@pytest.mark.gpu
def test_an_accelerator_crawls_as_fast_as_the_processor(contact):
    if not wp.get_preferred_device().is_cuda:
        pytest.skip("there is no accelerator here")
    found = [
        run_scripts(TwinBatch([GEN2] * 2, contact=contact, engine=engine), [Gait(2.0), Gait(2.0, 0.2)], 10.0)
        for engine in ("cpu", "warp")
    ]
    for a, b in zip(*found, strict=True):
        way = [
            np.hypot(run["com_x"][-1] - run["com_x"][400], run["com_y"][-1] - run["com_y"][400])
            for run in (a, b)
        ]
        assert way[1] == pytest.approx(way[0], rel=5e-3)
