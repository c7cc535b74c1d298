"""Presets of the twin: what they set, what wins over them, where they are named, and that they are near."""

from __future__ import annotations

import pytest

from srs_twin import InputError, load_scenario, rollout
from srs_twin.comparison.metrics import headline, plant_metrics
from srs_twin.experiment import run_scenario

FAST = {"plants.twin.preset": "fast", "duration_s": 3.0}


def test_a_preset_fills_in_what_is_not_given_and_survives_being_written():
    scenario = load_scenario("gen2_straight", set=FAST)
    twin = scenario.build_plant("twin")
    assert (twin.contact, twin.timestep) == ("loaded", 0.002)
    written = scenario.document["plants"]["twin"]
    assert (written["preset"], written["contact"], written["timestep_s"]) == ("fast", "loaded", 0.002)
    own = load_scenario("gen2_straight", set=FAST | {"plants.twin.timestep_s": 0.001}).build_plant("twin")
    assert (own.contact, own.timestep) == ("loaded", 0.001)
    assert load_scenario("gen2_straight").build_plant("twin").contact == "preloaded"


def test_another_name_is_refused():
    with pytest.raises(InputError, match="did you mean fast"):
        load_scenario("gen2_straight", set={"plants.twin.preset": "fest"})


def test_who_ran_it_is_told(tmp_path):
    found = run_scenario(load_scenario("gen2_straight", set=FAST), tmp_path / "r")
    assert found.metrics["preset"] == "fast" and "preset is fast" in headline(found.metrics)


def test_it_is_as_near_as_the_documentation_says():
    def twin(**settings):
        scenario = load_scenario("gen2_straight", set={"duration_s": 3.0, "plants.twin": settings})
        return plant_metrics(
            rollout(scenario.build_plant("twin"), scenario.build_controller(), **scenario.timing)
        )

    fast, fine = twin(preset="fast"), twin(contact="loaded", timestep_s=0.00025)
    for name in ("com_speed_m_s", "mean_bend_amplitude_rad", "cost_of_transport"):
        assert fast[name] == pytest.approx(fine[name], rel=0.02)
