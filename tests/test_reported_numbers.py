"""Numbers in printed tables, JSON results and pictures, computed here in another way."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from srs_twin import AnalyticalSnake, Trajectory, TwinSnake, load_robot
from srs_twin.identification import design as design_module
from srs_twin.identification.design import CandidateExperiment, ExperimentDesign
from srs_twin.identification.estimate import half_width
from srs_twin.identification.identifiability import Accuracy, Identifiability
from srs_twin.identification.locomotion import measured_length
from srs_twin.identification.parameters import FreeParameter
from srs_twin.live.commands import CommandHistory
from srs_twin.live.messages import VALVES, Message
from srs_twin.live.session import summary
from srs_twin.planning.command import _quality_words
from srs_twin.planning.planned import PathQuality
from srs_twin.pneumatics.orifice import OrificeOptions
from srs_twin.reproduction import figures
from srs_twin.reproduction.claims import load_claims
from srs_twin.reproduction.report import summary_line
from srs_twin.reproduction.verdicts import ClaimOutcome, JudgedClaim

pytestmark = pytest.mark.fast


def fitted(bias: float, spread: float = 0.0) -> Accuracy:
    """Return the accuracy of a parameter with the value 10, two per unit of z."""
    return Accuracy(
        unknowns=(FreeParameter("a", "N", 4.0, -50.0, 50.0, 2.0),),
        z=np.array([5.0]),
        converged=True,
        inside=np.array([0]),
        known=Identifiability(
            np.array([[0.01**2]]), np.zeros(1), np.zeros((0, 1)), ("a",)
        ),
        bias=np.array([bias]),
        spread=np.array([spread]),
        quantile=2.5,
        explained=True,
    )


def test_a_value_shifted_by_model_error_names_the_value_without_it():
    for bias, value in ((0.5, 9), (-0.5, 11)):
        why = fitted(bias).parameter(0).why
        assert f"the reference simulates with {value} give this value" in why
    assert "model error" not in fitted(0.0).parameter(0).why


def test_the_interval_of_a_parameter_is_its_error_times_the_quantile():
    parameter = fitted(0.0).parameter(0)
    assert parameter.value == 10.0
    assert parameter.standard_error == pytest.approx(0.02)
    assert (parameter.low, parameter.high) == pytest.approx((9.95, 10.05))


def test_a_length_measured_by_markers_has_the_scatter_of_the_segments():
    spec = load_robot("gen2")
    length = spec.geometry.segment_length
    straight = length + np.array([1e-3, 3e-3, -1e-3, 5e-3])
    bends = np.linspace(-0.6, 0.6, 50)
    columns = {"time": np.arange(50) / 50}
    for j, own in enumerate(straight, start=1):
        columns[f"bend_{j}"] = bends
        columns[f"length_{j}"] = own + 0.02 * bends**2
    recording = SimpleNamespace(
        trajectory=Trajectory(columns),
        summary=SimpleNamespace(markers=SimpleNamespace(noise_m=2e-3)),
    )
    name = "geometry.segment_length_m"
    found = measured_length([recording], spec, [name])
    # The mean of 1, 3, −1 and 5 mm is 2 mm, their standard deviation √(20/3) mm.
    scatter = math.sqrt(20 / 3) / 2
    noise = math.sqrt(2) * 2.0 / 4
    error = 1e-3 * math.hypot(scatter, noise)
    assert found.value == pytest.approx(length + 2e-3)
    assert found.standard_error == pytest.approx(error)
    # Student's t for three degrees of freedom.
    assert half_width(1.0, 3) == pytest.approx(3.182446, rel=1e-6)
    assert found.high - found.low == pytest.approx(2 * 3.182446 * error, rel=1e-6)


def test_the_printed_design_has_the_widths_after_each_experiment(
    srs_twin, monkeypatch, tmp_path
):
    def experiment(text, minutes):
        return CandidateExperiment(text, minutes, np.zeros_like, np.ones_like)

    plan = ExperimentDesign(
        (experiment("10 pulls along", 6.0), experiment("weigh the robot", 2.5)),
        {"friction.mu_t": (0.0623, 0.0411), "mass.connectors_kg": (0.31, 0.0204)},
        {"friction.mu_t": 0.52, "mass.connectors_kg": 0.314},
        {"friction.mu_t": 0.05, "mass.connectors_kg": 0.015},
    )
    monkeypatch.setattr(design_module, "calibrate_design", lambda *given: plan)
    want = "friction.mu_t=5%,mass.connectors_kg=1.5%"
    printed = srs_twin(
        "calibrate", "design", "gen2", "--target-accuracy", want, cwd=tmp_path
    )
    rows = [" ".join(line.split()) for line in printed.stdout.splitlines()]
    assert "half of the 95 % interval min mu_t connectors_kg" in rows
    assert "robot file 52 % 31 %" in rows
    assert "after 1 6 6.2 % 31.0 %" in rows
    assert "after 2 2.5 4.1 % 2.0 %" in rows
    assert "2. weigh the robot" in rows
    unmet = [row for row in rows if "no further experiment" in row]
    assert len(unmet) == 1 and unmet[0].startswith("mass.connectors_kg")
    assert unmet[0].endswith("reaches 1.5 %")


def test_orifice_settings_are_described_in_the_units_of_their_names():
    options = OrificeOptions(
        critical_ratio=0.4, flow_limit=2e-4, line_volume=3e-5, leak_per_s=0.02
    )
    assert options.describe(48_300.0) == pytest.approx(
        {
            "critical_ratio": 0.4,
            "flow_limit_l_per_min": 12.0,  # 0.2 l/s
            "line_volume_ml": 30.0,
            "initial_line_pressure_kpa": 48.3,
            "leak_per_s": 0.02,
        }
    )
    # Without a limit of the flow, the line has no effect.
    assert OrificeOptions().describe(48_300.0)["initial_line_pressure_kpa"] is None


@pytest.mark.parametrize(
    ("ratio", "clearance", "is_given", "words"),
    [
        (1.25, 0.0304, False, "1.25 times the least length around the obstacles, 30"),
        (None, 0.0304, False, "least length 0: the start is within the goal's radius"),
        (None, 0.0304, True, "a given path, which may ignore obstacles, 30 mm of"),
        (1.0, 1e9, True, "1.00 times the least length around the obstacles, at least"),
    ],
)
def test_the_printed_quality_of_a_plan(ratio, clearance, is_given, words):
    text = _quality_words(PathQuality(ratio, clearance), "the edges", is_given)
    assert text.startswith(words)
    assert text.endswith("mm of clearance beyond the edges")


def test_the_summary_counts_the_rows_of_each_group():
    claims = load_claims()
    rows = []
    expected = {}
    for k, claim in enumerate(claims):
        verdict = ("met", "missed", "explained")[k % 3]
        outcome = ClaimOutcome(verdict, (1.0,), 1.0, 0.0)
        rows.append(JudgedClaim(claim, {"twin": outcome}))
        label = {
            "headline": "headline predictions",
            "shape": "orders and trends",
            "law": "laws",
        }.get(claim.category)
        if label:
            met, count = expected.get(label, (0, 0))
            expected[label] = (met + (verdict == "met"), count + 1)
    line = summary_line(rows)
    assert line.startswith(f"Of {len(claims)} rows the twin meets ")
    assert "without a plant" not in line and "analytical" not in line
    assert len(expected) == 3
    for label, (met, count) in expected.items():
        assert f" {met} of {count} {label}" in line


def test_the_figure_of_readings_shows_the_last_two_seconds():
    time = np.arange(501) / 100
    columns = {"time": time, "bend_1": 0.1 * time, "measured_bend_1": 0.1 * time + 0.01}
    drawn = figures._readings({"twin": Trajectory(columns)})
    measured_bend, bend = drawn.axes[0].lines
    assert (measured_bend.get_xdata()[0], measured_bend.get_xdata()[-1]) == (3.0, 5.0)
    assert np.allclose(bend.get_ydata(), 0.1 * bend.get_xdata())
    assert np.allclose(measured_bend.get_ydata() - bend.get_ydata(), 0.01)


def test_the_figure_of_a_step_shows_the_solution_of_eq_14():
    """Two lags in series with τ₁ and τ₂, integrated in small steps."""
    spec = load_robot("gen4_module")
    slow, fast = spec.actuator.tau_fill, spec.actuator.tau_mode
    run = Trajectory({"time": np.array([0.0, 5.0]), "bend_1": np.array([0.0, 0.5])})
    drawn = figures._step({"analytical": run}, spec)
    (line,) = (each for each in drawn.axes[0].lines if "Eq. 14" in each.get_label())
    step = 1e-5
    pressure = bend = 0.0
    states = []
    for _ in range(round(1 / step)):
        states.append(bend)
        bend += step * (pressure - bend) / fast
        pressure += step * (1 - pressure) / slow
    expected = 0.5 * np.interp(
        line.get_xdata(), step * np.arange(len(states)), np.array(states)
    )
    assert np.abs(line.get_ydata() - expected).max() < 1e-3
    assert line.get_ydata()[-1] > 0.25


@pytest.mark.parametrize("name", ["gen2", "gen4"])
def test_lumped_inertia_is_that_of_rods_of_half_a_pitch(name):
    """Each point has the mass of the rods on its sides; an end has one rod only."""
    spec = load_robot(name)
    body = AnalyticalSnake(spec, inertia="lumped").body
    mass = np.asarray(spec.mass.connectors)
    pitch = spec.geometry.segment_length + spec.geometry.rigid_gap
    rods = np.array([1, *[2] * (len(mass) - 2), 1])
    assert body.solid.inertia == pytest.approx(rods * mass * pitch**2 / 3)
    own = AnalyticalSnake(spec, inertia="connector").body.solid.inertia
    assert own == pytest.approx(spec.yaw_inertia())


def test_wheels_of_a_placed_twin_roll_without_slip():
    spec = load_robot("gen2")
    twin = TwinSnake(spec, contact="preloaded")
    state = twin.reset(pose=(0.0, 0.0, 0.3))
    model, data = twin.physics.model, twin.physics.data
    names = [model.joint(joint).name for joint in range(model.njnt)]
    wheels = [name for name in names if name.startswith("axle_")]
    assert len(wheels) >= spec.geometry.connectors
    # Along its straight body, the wheels turn by the distance over their radius; they
    # do not turn while the body slides sideways.
    turning = 0.2 / spec.geometry.wheel_radius
    for direction, rate in ((0.3, turning), (0.3 + math.pi / 2, 0.0)):
        velocity = 0.2 * np.array([math.cos(direction), math.sin(direction)])
        twin.set_state(replace(state, com_velocity=velocity))
        rates = [float(data.joint(name).qvel[0]) for name in wheels]
        assert rates == pytest.approx([rate] * len(wheels), abs=1e-9)


def test_a_report_of_valves_holds_from_one_tick_before_it():
    history = CommandHistory(1)
    filled = np.array([[1.0, -1.0]])
    history.add(1.0, Message(VALVES, "robot", 1.0, 1.0, filled))
    before, after = history.at(np.array([0.979, 0.981]))
    assert (before == 0.0).all()
    assert (after == [[1.0, 0.0]]).all()


def test_the_summary_of_a_shadow_has_the_counts_and_clocks_it_was_given():
    clock = SimpleNamespace(offset=2.5, jitter=0.003, jumps=1, uncertainty=0.004)
    counts = {
        ("robot", "bends", "late"): 3,
        ("capture", "bends", "late"): 4,
        ("robot", "bends", "taken"): 90,
    }
    shadow = SimpleNamespace(
        spec=load_robot("gen4"),
        buffer=SimpleNamespace(counts=counts, clocks={"robot": clock}),
    )
    known = SimpleNamespace(value=np.array([1.1]), sd=np.array([0.2]))
    estimate = SimpleNamespace(
        lost=False,
        pose=np.array([0.1, 0.2, 0.3]),
        pose_sd=np.array([0.01, 0.02, 0.03]),
        bend=np.array([0.4]),
        bend_sd=np.array([0.04]),
        off={"valve": 1},
        parameters={"gain": known},
    )
    links = [
        SimpleNamespace(counts={"bends": 50}),
        SimpleNamespace(counts={"bends": 7}),
    ]
    found = summary(shadow, links, estimate)
    assert found["messages"] == {"bends": 57}
    assert found["dropped"] == {"bends late": 7}
    assert found["clocks"] == {
        "robot": {
            "offset_s": 2.5,
            "jitter_s": 0.003,
            "jumps": 1,
            "age_uncertainty_s": 0.004,
        }
    }
    assert found["estimate"] == {
        "lost": False,
        "pose": [0.1, 0.2, 0.3],
        "pose_sd": [0.01, 0.02, 0.03],
        "bend_rad": [0.4],
        "bend_sd_rad": [0.04],
        "off": {"valve": 1},
        "parameters": {"gain": {"value": [1.1], "sd": [0.2]}},
    }
    assert "estimate" not in summary(shadow, links, None)
