"""Open-loop gait: wave of Eq. 13 from head to tail, times of its edges, and refused arguments."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from snakes import chain, robot

from srs_twin import Gait, InputError, RobotSpec, load_robot
from srs_twin.control.gait import PitchWave

pytestmark = pytest.mark.fast

TICK = 0.02


def played(
    gait: Gait, duration: float, *, tick: float = TICK, spec: RobotSpec | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return slot start times (s) and the signs S of the + chambers, shapes (n,) and (n, segments)."""
    spec = spec or robot()
    gait.reset(spec, tick)
    raster = max(1, round(tick / 1e-4))
    times = []
    signs = []
    for k in range(round(duration / tick)):
        valves = commanded(gait, k * tick)
        slots = valves[None] if valves.ndim == 2 else valves
        assert (slots[..., 0] == -slots[..., 1]).all()
        signs.append(np.repeat(slots[..., 0], raster // len(slots), axis=0))
        times.append(k * tick + tick * np.arange(raster) / raster)
    return np.concatenate(times), np.concatenate(signs)


def commanded(gait: Gait, time: float) -> np.ndarray:
    """Return the valves of the tick that begins at a time; a gait depends on no other state."""
    state: Any = SimpleNamespace(time=time)
    return gait.step(state)


def crossings(f: float, offset: float, lag: float, duration: float) -> list[float]:
    """Return the times at which sin(2π f t − lag) + offset changes its sign, ascending, s."""
    up = -math.asin(offset)
    down = math.pi + math.asin(offset)
    times = [
        (angle + lag + 2 * math.pi * n) / (2 * math.pi * f)
        for angle in (up, down)
        for n in range(-5, 200)
    ]
    return sorted(t for t in times if 1e-3 < t < duration - 1e-3)


@settings(max_examples=15)
@given(
    st.sampled_from([1.0, 1.7, 2.0, 3.3]),
    st.floats(-0.9, 0.9),
    st.floats(-3, 3),
    st.integers(0, 3),
)
def test_edges_are_at_the_zeros_of_the_sine_within_a_slot(f, offset, phase, j):
    time, signs = played(Gait(f, offset, phase=phase), 1.0)
    found = time[1:][np.diff(signs[:, j]) != 0]
    lag = j * math.pi / 2 - phase
    expected = np.array(crossings(f, offset, lag, 1.0))
    found = found[(found > 1e-3) & (found < 1 - 1e-3)]
    if len(found) == len(expected):
        assert np.abs(found - expected).max(initial=0.0) <= 1e-4
    else:  # an edge within 0.1 ms of the window's ends
        border = [
            t
            for t in crossings(f, offset, lag, 1.2)
            if min(abs(t - 1e-3), abs(t - 1 + 1e-3)) < 1e-4
        ]
        assert abs(len(found) - len(expected)) <= len(border)


@pytest.mark.parametrize("connectors", [2, 5, 9])
def test_wave_travels_from_head_to_tail(connectors):
    """Segment j + 1 repeats segment j with a delay of β/(2π f)."""
    spec = chain((0.03,) * connectors)
    f = 2.0
    step = 2 * math.pi / 8
    _, signs = played(Gait(f, 0.2, phase_step=step), 2.0, spec=spec)
    delay = round(step / (2 * math.pi * f) / 1e-4)
    for j in range(connectors - 2):
        assert (signs[delay:, j + 1] == signs[:-delay, j]).mean() > 0.9995


def test_wave_is_positive_at_its_zeros():
    # A tick of one slot is evaluated at its centre: the phase makes the sine exactly 0
    # there.
    gait = Gait(2.0, phase=-2 * math.pi * 2.0 * 0.5e-4)
    gait.reset(robot(), 1e-4)
    valves = commanded(gait, 0.0)
    assert valves.tolist()[0] == [1, -1]
    # Segments lag 0, π/2, π, 3π/2: sines 0, −1, 0 (rounded below), +1.
    assert valves[:, 0].tolist() == [1, -1, 1, 1]


def test_default_phase_step_is_that_of_the_robot():
    _, own = played(Gait(1.0), 1.0, spec=robot("gen1"))
    _, same = played(Gait(1.0, phase_step=robot("gen1").phase_step), 1.0)
    _, other = played(Gait(1.0), 1.0)
    assert (own == same).all()
    assert (own != other).any()


def test_ticks_without_an_edge_have_no_slots():
    gait = Gait(2.0)
    gait.reset(robot(), TICK)
    shapes = [commanded(gait, k * TICK).shape for k in range(100)]
    # With 2 Hz and phase steps of a quarter period, there are edges every 125 ms.
    assert set(shapes) == {(4, 2), (200, 4, 2)}
    assert sum(len(shape) == 3 for shape in shapes) == 16 - 4
    assert commanded(gait, 0.0).dtype == np.int8


def test_pulses_shorter_than_a_tick_are_kept():
    """At an offset near 1, the − phase is shorter than a tick and not visible at its ends."""
    gait = Gait(2.0, 0.999)
    tick = 0.1
    _, signs = played(gait, 2.0, tick=tick)
    expected = (math.pi - 2 * math.asin(0.999)) / (4 * math.pi)
    assert expected < tick / 5
    assert (signs == -1).mean(axis=0) == pytest.approx(expected * 2, rel=0.05)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("frequency", [0.0, -1.0, math.nan, math.inf])
def test_invalid_frequencies_are_refused(frequency):
    with pytest.raises(InputError, match=r"gait frequency .* Hz .* finite and above 0"):
        Gait(frequency)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("offset", [1.0, -1.0, 2.0, math.nan])
def test_offsets_without_a_wave_are_refused(offset):
    with pytest.raises(
        InputError, match=r"gait offset .* is not allowed; it must be between -1 and 1"
    ):
        Gait(2.0, offset)
    gait = Gait(2.0)
    with pytest.raises(InputError, match="gait offset"):
        gait.offset = offset
    assert gait.offset == 0.0


def test_tick_that_is_no_multiple_of_a_slot_has_a_whole_number_of_slots():
    gait = Gait(2.0)
    gait.reset(robot(), 0.02005)
    edges = gait.script(100 * 0.02005).starts / (0.02005 / 200)
    assert edges == pytest.approx(np.round(edges), abs=1e-6)


@given(
    rest=st.floats(0.0, 0.9),
    offset=st.floats(-0.5, 0.5),
    shifts=st.lists(st.floats(-3, 3), min_size=4, max_size=4),
)
@settings(max_examples=50)
def test_script_equals_the_valves_of_the_ticks(rest, offset, shifts):
    """The slots of every tick equal those of the script."""
    spec = load_robot("gen2")
    gait = Gait(2.0, offset, phases=shifts, rest_fraction=rest)
    gait.reset(spec, 0.02)
    script = gait.script(1.0)
    for k in range(50):
        valves = gait.valves_at(0.02 * k)
        slots = (
            valves
            if valves.ndim == 3
            else np.broadcast_to(valves, (200, *valves.shape))
        )
        for slot in (0, 99, 199):
            time = 0.02 * k + (slot + 0.5) * 1e-4
            row = np.searchsorted(script.starts, time, side="right") - 1
            assert (script.states[row] == slots[slot]).all()


def test_rest_fraction_vents_that_fraction_of_the_period():
    gait = Gait(2.0, rest_fraction=0.3)
    gait.reset(load_robot("gen2"), 0.02)
    script = gait.script(1.0)
    lasts = np.diff(np.append(script.starts, 1.0))
    assert lasts @ (script.states == -1).all(axis=-1) == pytest.approx(
        np.full(4, 0.3), abs=2e-3
    )


@pytest.mark.parametrize(
    ("more", "why"),
    [
        ({"rest_fraction": 1.0}, "gait `rest_fraction` 1.0"),
        ({"phases": [0.1, 0.2]}, "2 phases are given, but gen2 has 4"),
    ],
)
def test_invalid_waves_are_refused(more, why):
    with pytest.raises(InputError, match=why):
        Gait(2.0, **more).reset(load_robot("gen2"), 0.02)


@pytest.mark.parametrize(
    ("fraction", "left", "up"), [(0.25, 1.0, 1 / 3), (0.75, 1 / 3, 1.0)]
)
def test_pitch_fraction_sets_the_rest_of_both_waves(fraction, left, up):
    """A wave that rests for a fraction r has the amplitude cos(π r/2).

    Each of its two chambers fills for (1 − r)/2 of the time.
    """
    gait = Gait(2.0, pitch=PitchWave(fraction, 0.4, 2.0, lifted_segments=1))
    gait.reset(load_robot("spatial_example"), 0.02)
    script = gait.script(1.0)
    lasts = np.diff(np.append(script.starts, 1.0))
    filled = np.tensordot(lasts, script.states == 1, axes=1)
    assert filled[0] == pytest.approx([0, 0, 1, 0])
    fills = [math.asin(amplitude) / math.pi for amplitude in (left, left, up, up)]
    assert filled[1:] == pytest.approx(np.tile(fills, (7, 1)), abs=2e-3)
    # The upper chamber of segment 2 begins to fill when the pitch wave exceeds its rest.
    begins = script.starts[1:][np.diff(script.states[:, 1, 2]) > 0]
    lag = gait.phase_lag[1] + (0.4 + math.acos(up)) / 2
    assert begins[0] % 0.25 == pytest.approx(lag / (4 * math.pi) % 0.25, abs=2e-4)
    slots = gait.valves_at(0.12)
    rows = np.searchsorted(script.starts, 0.12 + 1e-4 * np.arange(200) + 5e-5) - 1
    assert (slots == script.states[rows]).all()


@pytest.mark.parametrize(
    ("wave", "why"),
    [
        ({"fraction": 1.1}, "pitch fraction 1.1 is not allowed"),
        ({"lag_rad": math.inf}, "pitch lag inf is not allowed"),
        ({"frequency_ratio": 0.0}, "pitch frequency ratio 0.0 1 is not allowed"),
        ({"lifted_segments": -1}, "-1 lifted segments are not allowed"),
        ({"lifted_segments": 9}, "9 lifted segments .* has only 8 segments"),
    ],
)
def test_invalid_pitch_waves_are_refused(wave, why):
    with pytest.raises(InputError, match=why):
        Gait(2.0, pitch=PitchWave(**wave)).reset(load_robot("spatial_example"), 0.02)
