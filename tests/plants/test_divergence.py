"""NaN, infinity and 1e15 in running snakes are detected within a tick, and earlier samples are kept."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from snakes import robot, vented
from subsets import first_by_default

from srs_twin import (
    AnalyticalSnake,
    Controller,
    DivergedError,
    Gait,
    InputError,
    Plant,
    PreloadedContact,
    SnakeState,
    Trajectory,
    TwinBatch,
    TwinSnake,
    rollout,
    run_batch,
)
from srs_twin.compute.arrays import LARGEST_PLAUSIBLE, first_implausible, is_plausible
from srs_twin.plants.analytical import kernels
from srs_twin.plants.analytical.compliant_kernels import BENDS
from srs_twin.plants.base import check_plausible
from srs_twin.pneumatics.valves import Schedule

SPEC = robot()
TICK = 0.02
AT = 0.04
WILD = (np.nan, np.inf, -np.inf, 1e15, -1e15)

Spoil = Callable[[Any, float], None]


def put(path: str, index: Any = None) -> Spoil:
    """Return a function that writes a value into an attribute of a plant, or into an element of it."""

    def spoil(plant: Any, value: float) -> None:
        *owners, name = path.split(".")
        for part in owners:
            plant = getattr(plant, part)
        if index is None:
            setattr(plant, name, value)
        else:
            getattr(plant, name)[index] = value

    return spoil


BODY = {
    name: put("body.state", getattr(kernels, name))
    for name in (
        *("STATE_X", "STATE_Y", "HEADING", "STATE_VX", "STATE_VY"),
        *("MOMENT", "ENERGY_LOSS"),
    )
}
YIELDING = {
    "bend": put("body.state", BENDS),
    "last bend": put("body.state", BENDS + 3),
    "moment of a segment": put("body.state", BENDS + 4),
    "bend rate": put("body.velocity", 3),
}
TWIN = {
    "place": put("physics.data.qpos", 0),
    "height": put("physics.data.qpos", 2),
    "quaternion": put("physics.data.qpos", 3),
    "hinge": put("physics.data.qpos", 8),
    "speed": put("physics.data.qvel", 1),
    "spin": put("physics.data.qvel", 5),
    "hinge's rate": put("physics.data.qvel", 8),
    "heading": put("_connector_heading", 2),
    "work": put("_energy_loss"),
    "internal loss": put("_internal_loss"),
}
LAG = {
    "pressure": put("pneumatics.pressure", (1, 0)),
    "free bend": put("pneumatics.bend", 2),
    "air": put("pneumatics.pneumatic_energy"),
}
ORIFICE = {
    "amount of air": put("pneumatics._state", (1, 0)),
    "free bend": put("pneumatics._state", (1, 2)),
    "air drawn": put("pneumatics._amounts", 1),
    "pressure": put("pneumatics.pressure", (1, 0)),
}
CASES: dict[str, tuple[Callable[[], Plant], dict[str, Spoil]]] = {
    "complete": (partial(AnalyticalSnake, SPEC), BODY | LAG),
    "complete, orifice": (
        partial(AnalyticalSnake, SPEC, pneumatics="orifice"),
        BODY | ORIFICE,
    ),
    "simplified": (partial(AnalyticalSnake, SPEC, model="simplified"), BODY | LAG),
    "compliant": (
        partial(AnalyticalSnake, SPEC, model="compliant"),
        BODY | YIELDING | LAG,
    ),
    "compliant, orifice": (
        partial(AnalyticalSnake, SPEC, model="compliant", pneumatics="orifice"),
        BODY | YIELDING | ORIFICE,
    ),
    "twin": (partial(TwinSnake, SPEC, contact="preloaded"), TWIN | LAG),
    "twin on skids": (
        partial(TwinSnake, SPEC, contact=PreloadedContact("skid")),
        TWIN | LAG,
    ),
    "twin on its loads": (partial(TwinSnake, SPEC, contact="loaded"), TWIN | LAG),
    "twin, orifice": (partial(TwinSnake, SPEC, pneumatics="orifice"), TWIN | ORIFICE),
}


@pytest.fixture(autouse=True)
def _no_numpy_warning() -> Iterator[None]:
    """Turn NumPy warnings into errors: the user gets one message only."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def at(time: float, act: Callable[[], None]) -> Callable[[SnakeState], None]:
    """Return an observer that acts once, at a given time."""
    done: list[float] = []

    def observe(state: SnakeState) -> None:
        if float(state.time) > time - 1e-9 and not done:
            done.append(time)
            act()

    return observe


def assert_kept(error: DivergedError, until: float) -> None:
    """Check that the error's trajectory has exactly the samples before the divergence."""
    kept = error.trajectory
    assert isinstance(kept, Trajectory)
    assert kept.time[-1] >= until - 1e-9
    for name, column in kept.columns.items():
        assert (np.abs(column) < LARGEST_PLAUSIBLE).all(), name


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_implausible_state_is_detected_within_a_tick(case):
    build, spoils = CASES[case]
    plant = build()
    for name, spoil in spoils.items():
        for value in WILD:
            spoiling = at(AT, partial(spoil, plant, value))
            with pytest.raises(DivergedError) as caught:
                rollout(plant, Gait(2.0), 0.3, observers=[spoiling])
            error = caught.value
            assert error.exit_code == 3, (name, value)
            assert AT - 1e-9 <= error.time <= AT + TICK + 1e-9, (name, value)
            assert_kept(error, AT)
    # The plant is fit again after a reset.
    assert np.isfinite(rollout(plant, Gait(2.0), 0.1).com).all()


@pytest.mark.parametrize("case", ["complete", "compliant", "twin", "twin, orifice"])
def test_script_is_checked_between_chunks(case):
    build, spoils = CASES[case]
    plant = build()
    plant.max_chunk_s = AT
    for spoil in spoils.values():
        spoiling = at(AT, partial(spoil, plant, 1e15))

        def between(time: float, spoiling: Callable[[Any], None] = spoiling) -> None:
            spoiling(SimpleMoment(time))

        with pytest.raises(DivergedError) as caught:
            rollout(plant, Gait(2.0), 0.2, progress=between)
        assert AT - 1e-9 <= caught.value.time <= AT + TICK + 1e-9
        assert_kept(caught.value, AT)


class SimpleMoment:
    """Fields of a state that `at` needs."""

    def __init__(self, time: float) -> None:
        self.time = time


@pytest.mark.parametrize("record_hz", [10, 500])
def test_samples_before_divergence_are_kept_at_any_rate(record_hz):
    plant = AnalyticalSnake(SPEC)
    spoiling = at(0.2, partial(BODY["STATE_X"], plant, 1e15))
    with pytest.raises(DivergedError) as caught:
        rollout(plant, Gait(2.0), 0.4, record_hz=record_hz, observers=[spoiling])
    assert caught.value.trajectory.time == pytest.approx(
        np.arange(0.2 * record_hz + 1) / record_hz
    )


class Runaway(Controller):
    """Controller whose commands diverge after several ticks."""

    kind = "runaway"

    def __init__(self, valves: Any, *, after: int = 2, scripted: bool = False) -> None:
        self._valves = valves
        self._after = after
        self._scripted = scripted

    def reset(self, spec: Any, tick: float, *, seed: int = 0) -> None:
        self._tick = tick
        self._count = 0

    def step(self, state: SnakeState) -> Any:
        self._count += 1
        return self._valves if self._count > self._after else vented(SPEC)

    def script(self, duration: float) -> Schedule | None:
        if not self._scripted:
            return None
        states = np.stack([vented(SPEC).astype(float), self._valves])
        return Schedule(duration, np.array([0.0, self._after * self._tick]), states)


def with_one(value: float) -> np.ndarray:
    valves = vented(SPEC).astype(float)
    valves[2, 1] = value
    return valves


@pytest.mark.default_cases(at=[0, 5, 8])
@pytest.mark.parametrize("build", [AnalyticalSnake, TwinSnake])
@pytest.mark.parametrize("value", WILD)
def test_diverged_controller_is_named_with_the_time(build, value):
    wild = with_one(value)
    for valves in (wild, np.stack([vented(SPEC), wild]), wild.tolist()):
        with pytest.raises(DivergedError) as caught:
            rollout(build(SPEC), Runaway(valves), 0.3)
        assert (
            str(caught.value)
            == f"controller 'runaway' diverged at t = {AT} s: the commanded"
            f" value {value:g} is no valve state"
        )
        assert_kept(caught.value, AT)


def test_integer_commands_can_diverge():
    with pytest.raises(DivergedError, match=r"the commanded value 1e\+15"):
        rollout(AnalyticalSnake(SPEC), Runaway(np.full((4, 2), 10**15)), 0.3)


@pytest.mark.parametrize("build", [AnalyticalSnake, TwinSnake])
def test_diverged_script_is_reported_in_its_chunk(build):
    plant = build(SPEC)
    plant.max_chunk_s = TICK
    with pytest.raises(
        DivergedError, match=rf"controller 'runaway' diverged at t = {AT} s"
    ) as caught:
        rollout(plant, Runaway(with_one(np.nan), scripted=True), 0.3)
    assert_kept(caught.value, AT)


@pytest.mark.parametrize("build", [AnalyticalSnake, TwinSnake])
def test_script_may_have_float_states(build):
    assert len(rollout(build(SPEC), Runaway(with_one(1.0), scripted=True), 0.1)) == 11


@pytest.mark.default_cases(3)
@pytest.mark.parametrize(
    ("valves", "words"),
    [
        (np.full((3, 2), np.int8(1)), r"the valves have the shape \(3, 2\)"),
        (np.zeros((0, 4, 2)), r"\(0, 4, 2\), .* at least one slot"),
        ([[1, -1], [1]], r"the valves \[\[1, -1\], \[1\]\] are not allowed"),
        (np.zeros((4, 2)), "valve state 0.0 is not supported by layout 3/2"),
        (np.full((4, 2), 2), "valve state 2 is not supported"),
        (np.full((4, 2), "open"), "valve state open is not supported"),
    ],
)
def test_invalid_finite_commands_are_input_errors(valves, words):
    for plant in (AnalyticalSnake(SPEC), TwinSnake(SPEC)):
        with pytest.raises(InputError, match=f"^controller 'runaway': .*{words}"):
            rollout(plant, Runaway(valves), 0.3)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("spoil", first_by_default(4, [*TWIN, *LAG]))
def test_diverged_twin_ends_alone_in_its_batch(spoil):
    batch = TwinBatch([SPEC, SPEC, SPEC], threads=2)
    sound = run_batch(batch, lambda state: np.stack([vented(SPEC)] * 3), 0.2)
    for value in (np.nan, np.inf, 1e15):
        act = at(AT, partial((TWIN | LAG)[spoil], batch.twins[1], value))

        def policy(state: SnakeState, act: Callable[[Any], None] = act) -> np.ndarray:
            act(state.at(0))
            return np.stack([vented(SPEC)] * 3)

        first, error, last = run_batch(batch, policy, 0.2)
        assert isinstance(error, DivergedError) and error.time <= AT + TICK + 1e-9
        assert_kept(error, AT)
        assert batch.errors == [None, error, None]
        assert batch.state.time[[0, 2]] == pytest.approx(0.2)
        assert batch.state.time[1] <= error.time
        for run, before in ((first, sound[0]), (last, sound[2])):
            assert all(
                np.array_equal(run[name], before[name]) for name in before.columns
            )


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("value", WILD)
def test_policy_diverging_for_one_run_ends_that_run_only(value):
    batch = TwinBatch([SPEC, SPEC], threads=1)

    def policy(state: SnakeState) -> np.ndarray:
        wild = (
            with_one(value)
            if state.time.max() > AT - 1e-9
            else vented(SPEC).astype(float)
        )
        return np.stack([vented(SPEC).astype(float), wild])

    first, error = run_batch(batch, policy, 0.2)
    assert isinstance(first, Trajectory) and len(first) == 21
    assert isinstance(error, DivergedError)
    assert (
        str(error)
        == f"policy diverged at t = {AT} s: the commanded value {value:g} is no valve"
        " state"
    )
    assert error.trajectory.time == pytest.approx(np.arange(5) / 100)


def test_history_ends_before_its_first_implausible_sample():
    plant = AnalyticalSnake(SPEC)
    history = SnakeState.history([plant.step(vented(SPEC)) for _ in range(4)])
    assert check_plausible("analytical", history) is history
    history.com[2, 1] = -np.inf
    with pytest.raises(
        DivergedError, match=r"^analytical diverged at t = 0.06 s: `com` is -inf"
    ) as caught:
        check_plausible("analytical", history)
    assert caught.value.history.time == pytest.approx([0.02, 0.04])


@pytest.mark.parametrize("count", [1, 10**6])
def test_plausibility_is_independent_of_array_size(count):
    large = np.full(count, 0.99 * LARGEST_PLAUSIBLE)
    assert is_plausible(large) and first_implausible(large) is None
    large[-1] = LARGEST_PLAUSIBLE
    assert not is_plausible(large) and first_implausible(large) == LARGEST_PLAUSIBLE


SCENARIO = """\
robot: gen2
duration_s: 0.4
supply: {pressure_kpa: 2000}
allow_overpressure: true
controller: {kind: gait, frequency_hz: 2.0}
plants:
  twin: {}
  analytical: {}
"""


def test_diverged_scenario_exits_with_3_and_keeps_its_last_state(tmp_path, srs_twin):
    (tmp_path / "burst.yaml").write_text(SCENARIO)
    done = srs_twin("run", "--quiet", "burst.yaml", cwd=tmp_path)
    assert done.returncode == 3, done.stderr
    assert "burst: twin diverged at t = 0.1" in done.stderr
    assert done.stderr.rstrip().endswith(
        "the trajectory up to that time is in runs/burst/twin.parquet"
    )
    assert "Traceback" not in done.stderr and done.stdout == ""
    folder = tmp_path / "runs/burst"
    assert sorted(os.listdir(folder)) == [
        "analytical.parquet",
        "scenario.resolved.yaml",
        "twin.parquet",
    ]
    kept = Trajectory.from_parquet(Path(folder / "twin.parquet"))
    assert 0.0 < kept.time[-1] < 0.2
    assert all(np.isfinite(column).all() for column in kept.columns.values())
    assert Trajectory.from_parquet(folder / "analytical.parquet").time[
        -1
    ] == pytest.approx(0.4)
