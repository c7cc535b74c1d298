"""Curvature sensors: magnetostatics, strip geometry, electronics, calibration and noise."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
import sensor_strips as study
from benchmark_runs import run_benchmark
from hypothesis import given, strategies as st
from scipy import stats

from srs_twin import AnalyticalSnake, Gait, TwinSnake, load_robot, rollout
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.sensing import (
    CurvatureSensor,
    HallSensor,
    IdealSensor,
    Strip,
    calibrate,
    make_sensor,
)
from srs_twin.sensing.hall import (
    SPAN,
    element_place,
    field,
    fit_line,
)
from srs_twin.sensing.sensors import SLOT, _splitmix, standard_normal

MU0_4PI = 1e-7
LENGTH = 0.075
GEN4 = load_robot("gen4")
BENDS = np.linspace(-np.pi / 2, np.pi / 2, 361)

HEIGHT = st.floats(-0.0009, 0.0009)
STRIPS = st.builds(
    Strip,
    segment_length=st.floats(0.02, 0.1),
    distance=st.floats(0.0031, 0.0046),
    orientation=st.sampled_from(["up", "side"]),
    moment=st.floats(1e-4, 1e-2),
    magnet_height=HEIGHT,
    element_height=HEIGHT,
)
BEND = st.floats(-np.pi / 2, np.pi / 2)
SEED = st.integers(-(2**70), 2**70)


def flat(orientation: str, height: float = 0.0) -> Strip:
    return Strip(
        LENGTH, orientation=orientation, magnet_height=height, element_height=height
    )


def potential(r: np.ndarray, moment: np.ndarray) -> float:
    """Return the scalar potential of a dipole times μ₀; the field is its negative gradient."""
    return float(MU0_4PI * moment @ r / np.linalg.norm(r) ** 3)


def slope_along(r: np.ndarray, moment: np.ndarray, direction: np.ndarray) -> float:
    h = 1e-4 * np.linalg.norm(r)
    ahead = potential(r + h * direction, moment)
    behind = potential(r - h * direction, moment)
    return (ahead - behind) / (2 * h)


# The field


@given(strip=STRIPS, bend=st.floats(-6, 6))
def test_element_place_is_the_integral_along_the_strip(strip, bend):
    s = (np.arange(2000) + 0.5) / 2000 * strip.distance
    heading = bend / strip.segment_length * s
    end = bend / strip.segment_length * strip.distance
    foot = strip.distance * np.array([np.cos(heading).mean(), np.sin(heading).mean()])
    normal = np.array([-math.sin(end), math.cos(end)])
    required = foot + strip.element_height * normal - [0.0, strip.magnet_height]
    x, y, theta = element_place(bend, strip)
    assert (x, y) == (
        pytest.approx(required[0], abs=1e-9),
        pytest.approx(required[1], abs=1e-9),
    )
    assert theta == pytest.approx(end, abs=1e-12)


@given(strip=STRIPS, bend=BEND)
def test_equation_1_is_the_field_component_normal_to_the_element(strip, bend):
    x, y, theta = (float(value) for value in element_place(bend, strip))
    moment = strip.moment * np.array(
        [0.0, 1.0] if strip.orientation == "up" else [1.0, 0.0]
    )
    normal = np.array([-math.sin(theta), math.cos(theta)])
    wanted = -slope_along(np.array([x, y]), moment, normal)
    scale = MU0_4PI * strip.moment / math.hypot(x, y) ** 3
    assert float(field(bend, strip)) == pytest.approx(wanted, abs=1e-6 * scale)


def test_field_at_rest_is_that_of_the_magnet():
    """An N42 cylinder of 1/16 by 1/32 inch lies 0.05 mm, and the element 0.7 mm, above."""
    inch = 0.0254
    volume = math.pi / 4 * (inch / 16) ** 2 * inch / 32
    moment = np.array([0.0, 1.32 * volume / (4e-7 * math.pi)])
    place = np.array([3.1e-3, 0.7e-3 - (0.05e-3 + inch / 64)])
    wanted = -slope_along(place, moment, np.array([0.0, 1.0]))
    assert float(field(0.0, Strip(LENGTH))) == pytest.approx(wanted, rel=1e-6)


def test_vertical_magnet_on_the_neutral_axis_cannot_sense_the_side():
    for orientation, sign in (("up", 1), ("side", -1)):
        b = field(BENDS, flat(orientation))
        assert b == pytest.approx(sign * b[::-1], abs=1e-18)
    with pytest.raises(
        InputError,
        match=r"cannot be calibrated over ±1\.5708 rad, because a line explains only"
        r" 0\.0%",
    ):
        calibrate(HallSensor.trimmed(flat("up")))


# The electronics


def plain(**changes: object) -> HallSensor:
    return HallSensor.trimmed(Strip(LENGTH), **changes)


@given(bend=BEND, bits=st.integers(1, 16))
def test_readings_are_quantised(bend, bits):
    smooth = plain(bits=None)
    stepped = plain(bits=bits)
    read = float(stepped.voltage(bend))
    assert stepped.step == 5 / 2**bits
    assert read / stepped.step - 0.5 == pytest.approx(
        round(read / stepped.step - 0.5), abs=1e-9
    )
    assert abs(read - float(smooth.voltage(bend))) <= stepped.step / 2 * (1 + 1e-9)


def test_trimmed_amplifier_uses_its_rail_fraction():
    for strip in (
        Strip(LENGTH),
        Strip(0.037, orientation="side"),
        Strip(LENGTH, chamber="rectangular"),
    ):
        sensor = HallSensor.trimmed(strip, bits=None)
        volts = sensor.voltage(np.linspace(-SPAN, SPAN, 181))
        assert np.abs(volts - 2.5).max() == pytest.approx(0.8 * 2.5, rel=1e-12)
        assert sensor.voltage(0.0) == 2.5


def test_rails_and_converter_limit_the_reading():
    loud = replace(plain(bits=None), gain=1e5, rails=(0.3, 4.6))
    assert set(loud.voltage(np.array([-1.0, 1.0]))) == {0.3, 4.6}
    narrow = replace(loud, bits=8, converter_range=(1.0, 3.0))
    step = 2 / 256
    assert narrow.voltage(np.array([-1.0, 1.0])) == pytest.approx(
        [3 - step / 2, 1 + step / 2], abs=1e-12
    )


@given(bias=st.floats(-0.2, 0.2), bend=BEND)
def test_bias_shifts_the_angle_by_the_calibration_slope(bias, bend):
    fresh = CurvatureSensor.calibrated(plain(bits=None, noise=0.0))
    drifted = CurvatureSensor.calibrated(plain(bits=None, noise=0.0, bias=bias))
    assert drifted.calibration == fresh.calibration
    moved = drifted.read(np.array([bend]), 0.0, 0) - fresh.read(
        np.array([bend]), 0.0, 0
    )
    assert moved == pytest.approx([fresh.calibration.slope * bias], abs=1e-12)


def test_gain_error_scales_the_voltage_about_its_offset():
    fresh = plain(bits=None)
    drifted = plain(bits=None, gain_error=0.1)
    assert drifted.gain == fresh.gain
    assert drifted.voltage(BENDS) - 2.5 == pytest.approx(
        1.1 * (fresh.voltage(BENDS) - 2.5), abs=1e-12
    )


def test_nan_bend_gives_nan_reading():
    sensor = make_sensor("hall", GEN4)
    bend = np.array([[0.3, np.nan, -0.2, np.inf], [1e9, 0.1, -np.inf, 0.0]])
    read = sensor.read(bend, np.array([0.1, 0.2]), 3)
    assert np.isnan(read).tolist() == [
        [False, True, False, True],
        [True, False, True, False],
    ]
    alone = sensor.read(np.array([[0.3, 0.0, -0.2, 0.0]]), np.array([0.1]), 3)
    assert read[0, [0, 2]].tolist() == alone[0, [0, 2]].tolist()
    assert math.isnan(IdealSensor().read(np.array([np.nan]), 0.0, 0)[0])


# The chambers


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("robot", ["gen1", "gen2", "gen3", "gen4"])
def test_reading_is_monotonic_with_semicircular_chambers_only(robot):
    spec = load_robot(robot)
    good = make_sensor("hall", spec, bits=None)
    bad = make_sensor("hall", spec, bits=None, chamber="rectangular")
    assert (np.diff(good.hall.voltage(BENDS)) < 0).all()
    assert good.calibration.monotonic
    assert not bad.calibration.monotonic
    turned = np.abs(BENDS[1:][np.diff(bad.hall.voltage(BENDS)) > 0])
    # tanh'(q/q_c) = 1/2 at 0.88 q_c: there the reading turns; the field's own curvature
    # moves it a little.
    assert turned.max() == pytest.approx(math.acosh(math.sqrt(2)) * 0.15, abs=0.02)
    assert bad.calibration.r_squared < good.calibration.r_squared
    assert bad.calibration.worst_error > good.calibration.worst_error


def test_pressing_saturates_for_round_chambers():
    good = Strip(LENGTH)
    bad = Strip(LENGTH, chamber="rectangular")
    shift = 2 * 0.15
    far = np.linspace(1.2, 2.0, 9)
    assert field(far, bad) == pytest.approx(field(far - shift, good), rel=1e-6)
    assert field(-far, bad) == pytest.approx(field(-far + shift, good), rel=1e-6)
    assert field(0.0, bad) == field(0.0, good)


# The calibration


def test_fit_agrees_with_scipy():
    rng = np.random.default_rng(1)
    angle = np.linspace(-1, 1, 60)
    voltage = 2 - 0.4 * angle + 0.05 * rng.standard_normal(60)
    values = fit_line(voltage, angle)
    theirs = stats.linregress(voltage, angle)
    assert (values.slope, values.intercept) == pytest.approx(
        (theirs.slope, theirs.intercept), rel=1e-9
    )
    assert values.r_squared == pytest.approx(theirs.rvalue**2, rel=1e-9)
    assert values.worst_error == pytest.approx(
        np.abs(values.angle(voltage) - angle).max(), rel=1e-9
    )
    assert not values.monotonic
    assert values.span == 1.0


@given(
    fraction=st.floats(-1, 1),
    span=st.floats(0.2, 1.6),
    bits=st.sampled_from([None, 8, 10, 12]),
)
def test_reading_error_is_within_the_worst_error(fraction, span, bits):
    """A monotonic reading between two angles is between their readings, so that spacing limits the error."""
    sensor = make_sensor("hall", GEN4, span=span, bits=bits, noise=0.0)
    error = sensor.read(np.array([fraction * span]), 0.0, 0) - fraction * span
    assert sensor.calibration.monotonic
    assert np.abs(error) <= sensor.calibration.worst_error + 2 * span / 180 + 1e-12


def test_sensor_study_results():
    """Section 2.2.2: L as in the dissertation; the sideways magnet is more linear (docs/module.md)."""
    near = 3.1
    far = 4.6
    for heights in ((0.45, 0.45), (0.45, 0.7), (0.7, 0.7)):
        up = [study.strip(d, heights, "up") for d in (near, far)]
        side = [study.strip(d, heights, "side") for d in (near, far)]
        assert study.reach(up[0]) > 2.5 * study.reach(up[1])
        assert study.reach(side[0]) > study.reach(side[1])
        assert study.line(up[0]).r_squared > study.line(up[1]).r_squared > 0.99
        assert min(study.line(s).r_squared for s in side) > study.line(up[0]).r_squared
    assert study.reach(study.strip(3.1, (0.45, 0.7), "up")) > study.reach(
        study.strip(3.1, (0.45, 0.7), "side")
    )
    assert study.reach(study.strip(3.1, (0.45, 0.45), "up")) < study.reach(
        study.strip(3.1, (0.45, 0.45), "side")
    )


def test_distant_cylinder_is_a_dipole():
    ratios = []
    for distance in (3.1, 12.4):
        strip = study.strip(distance, (0.45, 0.7), "up")
        ratios.append(study.of_cylinder(strip).mean() / field(BENDS, strip).mean())
    # The neglected terms decrease with the squared distance.
    assert abs(ratios[0] - 1) < 0.06
    assert (ratios[1] - 1) / (ratios[0] - 1) == pytest.approx(1 / 16, rel=0.2)


@pytest.mark.slow
def test_sensor_study_prints_and_plots(tmp_path):
    picture = tmp_path / "sensor.png"
    done = run_benchmark("sensor.py", "--out", str(picture))
    assert done.returncode == 0, done.stderr
    output = done.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert output.count("\n| --- |") == 5
    assert "| θ = q | up |" in output
    assert "nan" not in output


# The noise


def test_splitmix64_matches_reference_values():
    golden = np.uint64(0x9E3779B97F4A7C15)
    states = np.arange(1, 4, dtype=np.uint64) * golden  # seed 0
    assert [int(word) for word in _splitmix(states)] == [
        0xE220A8397B1DCDAF,
        0x6E789E6AA1B965F4,
        0x06C45D188009454F,
    ]


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("seed", [0, 1, -1, 2**64 - 2, 12345678901234567890123])
def test_noise_is_standard_normal_and_white(seed):
    n = 40_000
    z = standard_normal(seed, np.arange(n) * SLOT, 4)
    assert z.shape == (n, 4)
    assert np.abs(z.mean(axis=0)).max() < 5 / math.sqrt(n)
    assert np.abs(z.std(axis=0) - 1).max() < 5 / math.sqrt(2 * n)
    assert min(stats.kstest(column, "norm").pvalue for column in z.T) > 1e-4
    across = np.corrcoef(z.T) - np.eye(4)
    assert np.abs(across).max() < 5 / math.sqrt(n)
    for lag in (1, 2, 10, 100):
        assert np.abs((z[lag:, :3] * z[:-lag, 1:]).mean(axis=0)).max() < 5 / math.sqrt(
            n
        )
        # Not merely uncorrelated: sizes do not depend on each other either. RMS of z² −
        # 1 is √2.
        for before, after in itertools.product(
            (z, (z**2 - 1) / math.sqrt(2)), repeat=2
        ):
            covariance = (after[lag:] * before[:-lag]).mean(axis=0)
            assert np.abs(covariance).max() < 5 / math.sqrt(n)


def test_seeds_and_segments_are_independent():
    time = np.arange(20_000) * 1e-3
    every = np.concatenate(
        [standard_normal(seed, time, 3) for seed in range(6)], axis=1
    )
    assert np.abs(np.corrcoef(every.T) - np.eye(18)).max() < 5 / math.sqrt(len(time))
    assert len(np.unique(every)) == every.size


@given(seed=SEED, first=st.integers(-3000, 10**9), segments=st.integers(1, 4))
def test_single_readings_equal_those_of_a_whole_run(seed, first, segments):
    """Single readings come from cached blocks, those of a whole run do not."""
    slots = first + np.arange(0, 2600, 37)
    whole = standard_normal(seed, slots * SLOT, segments)
    for time, numbers in zip(slots * SLOT, whole, strict=True):
        single = standard_normal(seed, time, segments)
        assert single.shape == (segments,) and single.tolist() == numbers.tolist()
        assert standard_normal(seed, time, 1)[0] == numbers[0]
    many = standard_normal(seed, slots[:1, None] * SLOT, segments)
    assert many.shape == (1, 1, segments) and many.ravel().tolist() == whole[0].tolist()


def test_noise_is_constant_within_a_slot():
    ticks = np.arange(1, 5000)
    summed = np.cumsum(
        np.full(4999, 1e-3)
    )  # with rounding errors like the clock of a plant
    assert (standard_normal(1, summed, 1) == standard_normal(1, ticks * 1e-3, 1)).all()
    assert standard_normal(1, 0.0001, 1) != standard_normal(1, 0.0002, 1)
    assert (standard_normal(2**64 + 7, ticks, 2) == standard_normal(7, ticks, 2)).all()
    for time in (math.nan, math.inf, 1e300):
        with pytest.raises(InputError, match="times of sensor noise must be finite"):
            standard_normal(0, time, 1)


def test_noise_propagates_to_the_angle():
    sensor = make_sensor("hall", GEN4, bits=None)
    time = np.arange(20_000) * 1e-3
    read = sensor.read(np.full((20_000, 1), 0.4), time, 5)
    wanted = abs(sensor.calibration.slope) * sensor.hall.gain * sensor.hall.noise
    assert read.std() == pytest.approx(wanted, rel=0.03)
    assert math.radians(0.5) < wanted < math.radians(0.8)
    quiet = make_sensor("hall", GEN4, bits=None, noise=0.0).read(
        np.array([0.4]), 0.0, 5
    )
    assert read.mean() == pytest.approx(
        float(quiet[0]), abs=5 * wanted / math.sqrt(len(time))
    )


@pytest.mark.parametrize("plant", [AnalyticalSnake, TwinSnake])
def test_noise_differs_between_seeds_and_segments(plant):
    """A gait ignores the sensors: readings of two runs with different seeds differ by noise only."""
    sensor = make_sensor("hall", GEN4, bits=None)

    def read(seed):
        run = rollout(plant(GEN4, sensor=sensor), Gait(2.0), 1.0, seed=seed)
        return run.stack("measured_bend")

    first, again, *others = map(read, (1, 1, 2, 2**40 + 1))
    assert (first == again).all()
    noise = np.concatenate([first - other for other in others], axis=1)
    # The calibration is linear, so that noise does not depend on the bend.
    wanted = (
        math.sqrt(2)
        * abs(sensor.calibration.slope)
        * sensor.hall.gain
        * sensor.hall.noise
    )
    assert noise.std(axis=0) == pytest.approx(wanted, rel=0.3)


# Sensors by name and invalid options


def test_sensors_are_selected_by_name():
    ideal = make_sensor("ideal", GEN4)
    hall = make_sensor("hall", GEN4, orientation="side", bits=12)
    bend = np.array([[0.1, -0.2]])
    read = ideal.read(bend, 0.0, 1)
    read[0, 0] = 9
    assert bend.tolist() == [[0.1, -0.2]]
    assert hall.hall.strip.orientation == "side"
    assert hall.hall.strip.segment_length == GEN4.geometry.segment_length
    assert make_sensor(hall, GEN4) is hall
    assert make_sensor("hall", GEN4, gain=300.0).hall.gain == 300.0
    for sensor in (ideal, hall):
        assert (
            json.loads(json.dumps(sensor.describe(), allow_nan=False))["kind"]
            == sensor.kind
        )
    assert hall.describe()["calibration"]["r_squared"] > 0.99


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"kind": "halll"}, "unknown sensor 'halll'; did you mean hall?"),
        ({"kind": "ideal", "bits": 8}, "this sensor has no options; remove bits"),
        ({"bit": 8}, "unknown option of sensor 'hall' 'bit'; did you mean bits?"),
        ({"orientation": "upp"}, "unknown magnet orientation 'upp'; did you mean up?"),
        (
            {"chamber": "round"},
            (
                "unknown chamber cross-section 'round' (available: rectangular,"
                " semicircular)"
            ),
        ),
        (
            {"distance": 0.0},
            "`distance` 0.0 is not allowed; it must be finite and above 0",
        ),
        ({"moment": math.nan}, "`moment` nan is not allowed"),
        (
            {"distance": 0.2},
            "`distance` 0.2 m from magnet to element is not allowed; it must be at most",
        ),
        (
            {"element_height": 0.001},
            "`element_height` 0.001 m is not allowed; at this distance it must be within",
        ),
        ({"magnet_height": math.nan}, "`magnet_height` nan m is not allowed"),
        ({"gain": 0.0}, "`gain` 0.0 is not allowed; it must be finite and above 0"),
        (
            {"noise": -1e-6},
            "`noise` -1e-06 is not allowed; it must be finite and at least 0 V",
        ),
        (
            {"gain_error": -1.0},
            "`gain_error` -1.0 is not allowed; it must be finite and above -1",
        ),
        (
            {"bias": math.inf},
            "`bias` inf is not allowed; it must be finite and a voltage",
        ),
        ({"sensitivity": 0.0}, "`sensitivity` 0.0 is not allowed"),
        ({"bits": 0}, "`bits` 0 is not allowed; it must be between 1 and 32, or None"),
        (
            {"rails": (5.0, 0.0)},
            "`rails` 5.0 to 0.0 V is not allowed; it must be a finite range",
        ),
        (
            {"offset": 5.0},
            (
                "`offset` 5.0 is not allowed; it must be finite and between the rails"
                " 0 and 5 V"
            ),
        ),
        (
            {"offset": 0.1},
            "no gain is suitable for this sensor. The output of the element changes by",
        ),
        (
            {"gain": 1e-9, "offset": 2.501},
            "a calibration line cannot be fitted to voltages between 2.50244 and"
            " 2.50244 V",
        ),
        ({"span": -1.0, "gain": 500.0}, "calibration span -1.0 rad is not allowed"),
    ],
)
def test_invalid_sensor_options_raise(options, words):
    options = {"kind": "hall", **options}
    with pytest.raises(InputError) as error:
        make_sensor(options.pop("kind"), GEN4, **options)
    assert words in str(error.value)
    if "unknown" in words:
        assert isinstance(error.value, UnknownNameError)


@pytest.mark.parametrize(
    ("voltage", "angle", "words"),
    [
        ([1.0, 2.0], [0.0, 1.0], "a calibration needs 3 or more pairs"),
        ([1.0, 2.0, 3.0], [0.0, 1.0], "a calibration needs 3 or more pairs"),
        (
            [1.0, math.nan, 3.0],
            [0.0, 1.0, 2.0],
            "voltages and angles of a calibration must be finite",
        ),
        (
            [1.0, 1.0, 1.0],
            [0.0, 1.0, 2.0],
            "a calibration line cannot be fitted to voltages between 1 and 1 V",
        ),
        ([1.0, 2.0, 3.0], [0.0, 2.0, 1.0], "each angle must be larger"),
    ],
)
def test_invalid_calibration_pairs_raise(voltage, angle, words):
    with pytest.raises(InputError, match=words):
        fit_line(np.array(voltage), np.array(angle))
