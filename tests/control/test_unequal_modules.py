"""Iterative learning with unequal modules on both plants: straight, along a curve, and with a fault."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from srs_twin import Trajectory, rollout
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.scenario.loading import parse_scenario

both = pytest.mark.parametrize(
    "plant", ["analytical", pytest.param("twin", marks=pytest.mark.slow)]
)
_RUNS: dict[str, Trajectory] = {}


def run(
    plant: str,
    *,
    seed: int = 3,
    seconds: float = 18,
    faults: tuple[Any, ...] = (),
    **more: Any,
) -> Trajectory:
    """Return a run at 1 Hz and 131 kPa with gains that vary by 15 %, by default with a carrier of 120 Hz."""
    control = {
        "kind": "ilc",
        "frequency_hz": 1.0,
        "target_rad": 0.7,
        "carrier_hz": 120.0,
    } | more.pop("control", {})
    modules = {"gain_spread": 0.15} | more.pop("modules", {})
    scenario = parse_scenario(
        {
            "robot": {
                "base": "gen4",
                "modules": modules,
                "actuator": {"bend_limit_rad": 1.571},
            },
            "duration_s": seconds,
            "seed": seed,
            "supply": {"pressure_kpa": 131},
            "controller": control,
            "plants": {
                "analytical": {"model": "compliant", "friction": "wheel"},
                "twin": {},
            },
            "faults": list(faults),
            **more,
        }
    )
    key = f"{plant} {scenario.document}"
    if key not in _RUNS:
        _RUNS[key] = rollout(
            scenario.build_plant(plant), scenario.build_controller(), seconds
        )
    return _RUNS[key]


@pytest.mark.slow
@both
@pytest.mark.parametrize("seed", [3, 12])
def test_learning_straightens_a_snake_with_unequal_modules(plant, seed):
    found = plant_metrics(run(plant, seed=seed))
    assert found["path_bend_before_per_m"] > 0.5
    assert found["periods_to_converge"] <= 12
    assert found["path_bend_left_rel"] < 0.1


@pytest.mark.slow
@both
def test_a_steered_snake_with_unequal_modules_has_a_constant_curvature(plant):
    found = plant_metrics(run(plant, control={"offset": -0.3}))
    assert found["periods_to_converge"] <= 12 and found["path_radius_spread_rel"] < 0.05
    assert -0.6 < found["path_radius_m"] < -0.35


@both
@pytest.mark.parametrize(
    ("fault", "named"),
    [
        (
            {"kind": "stuck_valve", "chamber": "minus", "stuck": "closed"},
            "valve of the − chamber stuck shut",
        ),
        (
            {"kind": "stuck_valve", "chamber": "plus", "stuck": "open"},
            "valve of the + chamber stuck open",
        ),
        ({"kind": "dead_sensor"}, "sensor dead, all readings of a period are lost"),
        (
            {"kind": "dead_sensor", "reading_rad": 0.1},
            "sensor dead, readings stay within 0.02 rad",
        ),
    ],
    ids=["shut", "open", "lost", "frozen"],
)
@pytest.mark.slow
def test_faults_are_detected_and_the_other_modules_continue(plant, fault, named):
    found = run(plant, seconds=16, faults=({"segment": 2, "from_s": 6.0} | fault,))
    told = [event.text for event in found.events if event.kind == "fault"]
    assert told == [f"segment 2: {named}"]
    metrics = plant_metrics(found)
    assert metrics["amplitude_error_end_rel"] < 0.05, "of the three that are left"
    assert 0 <= metrics["duty_lowest"] <= metrics["duty_highest"] <= 1
    assert np.isnan(found["target_plus_2"][-1]) and found["duty_plus_2"][-1] == 0
