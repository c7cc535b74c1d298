"""Margins with a probability: coverage of the quantile and conditions of validity."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from srs_twin.errors import InputError, InputFileError
from srs_twin.identification import excursions
from srs_twin.planning.follower import ENDINGS
from srs_twin.planning.footprint_file import (
    LOST_M,
    ConditionsFile,
    ExcursionsFile,
    excursion_quantile,
    load_footprint_file,
    margin_for,
    save_footprint,
)
from srs_twin.scenario.loading import load_scenario

CONDITIONS = {
    "plant": "twin",
    "follower": "path",
    "gain_spread": 0.1,
    "turn_fraction": 0.5,
    "delay_s": 0.1,
    "position_noise_m": 0.002,
    "heading_noise_rad": 0.01,
    "lead_in_m": 0.4,
}


def conditions(**other: object) -> ConditionsFile:
    return ConditionsFile.model_validate(CONDITIONS | other)


def tried(excursion: float, **other: object) -> ExcursionsFile:
    """Return twenty runs that left the path by the excursion, and the lead-in by a tenth of it."""
    return ExcursionsFile(
        conditions=conditions(**other),
        source="drawn",
        path_m=[excursion] * 20,
        lead_in_m=[excursion / 10] * 20,
    )


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("draw", ["lognormal", "uniform", "standard_cauchy"])
@pytest.mark.parametrize("probability", [0.5, 0.9, 0.95])
def test_quantile_has_the_stated_coverage(draw, probability):
    """For any distribution: over many sets of 39 runs, between p and p + 1/40 of the new runs."""
    rng = np.random.default_rng(7)
    kept = [getattr(rng, draw)(size=40) + 100.0 for _ in range(4000)]
    held = np.mean(
        [
            each[-1] <= excursion_quantile(each[:-1].tolist(), probability)
            for each in kept
            if each[-1] > 0
        ]
    )
    noise = 3 * np.sqrt(probability * (1 - probability) / 4000)
    assert probability - noise <= held <= probability + 1 / 40 + noise


def test_too_few_or_lost_runs_give_no_margin():
    with pytest.raises(InputError, match="needs at least 19 measured runs"):
        excursion_quantile([0.01] * 18, 0.95)
    with pytest.raises(InputError, match="too many runs did not reach the goal"):
        excursion_quantile([0.01] * 90 + [LOST_M] * 10, 0.95)
    assert excursion_quantile([0.01] * 98 + [LOST_M] * 2, 0.95) == 0.01
    assert excursion_quantile([-0.02] * 19, 0.95) == 0.0


def test_margins_apply_to_conditions_no_more_difficult_than_measured():
    blocks = [
        tried(0.03),
        tried(0.06, gain_spread=0.2),
        tried(0.02, plant="analytical"),
    ]
    wanted = [
        conditions(gain_spread=0.05),
        conditions(plant="analytical", delay_s=0.05),
    ]
    margin = margin_for(blocks, 0.9, wanted)
    assert (margin.path, margin.lead_in) == pytest.approx((0.03, 0.003))
    assert margin_for(blocks, 0.9, [conditions(gain_spread=0.15)]).path == 0.06
    # The nearest of several conditions counts, even if more difficult ones have smaller
    # excursions by chance.
    luckier = [*blocks, tried(0.01, gain_spread=0.3)]
    assert margin_for(luckier, 0.9, wanted[:1]).path == 0.03
    others = (
        {"gain_spread": 0.3},
        {"delay_s": 0.2},
        {"lead_in_m": 0.3},
        {"tau_spread": 0.1},
        {"chambers": "orifice"},
        {"contact": "loaded"},
    )
    for other in others:
        with pytest.raises(
            InputError, match="no deviations from the path have been measured for"
        ):
            margin_for(blocks, 0.9, [conditions(**other)])


def test_excursions_without_a_contact_are_those_of_a_preloaded_twin():
    assert conditions() == conditions(contact="preloaded")
    blocks = [tried(0.03), tried(0.04, contact="loaded")]
    assert margin_for(blocks, 0.9, [conditions(contact="loaded")]).path == 0.04
    with pytest.raises(
        InputError,
        match="plant twin, contact loaded, .*; measure them with `srs-twin calibrate margin`",
    ):
        margin_for(blocks[:1], 0.9, [conditions(contact="loaded")])
    assert conditions(plant="analytical").contact is None
    with pytest.raises(
        ValueError, match="contact loaded is allowed only for `plant: twin`"
    ):
        conditions(plant="analytical", contact="loaded")


def test_scenario_with_another_contact_gets_no_margin():
    with pytest.raises(
        InputFileError,
        match="measured for plant twin, contact preloaded",
    ):
        load_scenario("follow_fig57", set={"plants.twin.contact": "preloaded"})


def test_footprint_of_another_contact_causes_a_warning():
    def warned(contact: str, footprint: str) -> list[str]:
        changes = {
            "planner.margin_probability": None,
            "planner.footprint": footprint,
            "plants.twin.contact": contact,
        }
        warnings = load_scenario("follow_fig57", set=changes).warnings
        return [each for each in warnings if "planner.footprint" in each]

    assert warned("loaded", "gen2_gait") == []
    assert warned("preloaded", "gen2_gait") == [
        "planner.footprint: gen2_gait was measured on a twin with contact loaded,"
        " but this twin has contact preloaded; `srs-twin calibrate footprint gen2"
        " --contact preloaded` measures a suitable footprint"
    ]
    assert warned("preloaded", "gen2_section52") == []


def test_footprint_of_another_robot_causes_a_warning():
    changes = {"planner.footprint": "gen4_table8"}
    assert (
        "planner.footprint: gen4_table8 is a footprint of gen4, but the robot here is"
        " gen2; `srs-twin calibrate footprint gen2 --contact loaded` measures a suitable"
        " footprint"
    ) in load_scenario("plan_fig54_3", set=changes).warnings
    assert "footprint gen4` measures" in load_footprint_file("gen2_gait").mismatch(
        "gen4", None
    )


def test_no_command_is_suggested_for_a_robot_that_is_not_shipped():
    text = load_footprint_file("gen2_gait").mismatch("own", None)
    assert text.endswith("is a footprint of gen2, but the robot here is own")


def test_the_command_plan_warns_of_the_footprint_of_another_robot(srs_twin, tmp_path):
    options = ("--set", "planner.footprint=gen4_table8", "--out", "out")
    done = srs_twin("plan", "plan_fig54_3", *options, cwd=tmp_path)
    assert done.stderr.startswith("warning: planner.footprint: gen4_table8 is a foot")


def test_a_footprint_file_without_a_contact_is_of_a_preloaded_twin(tmp_path):
    file = load_footprint_file("gen2_gait")
    assert file.contact == file.twin_contact == "loaded"
    before = file.model_copy(update={"contact": None})
    save_footprint(before, tmp_path / "before.yaml")
    again = load_footprint_file(tmp_path / "before.yaml")
    assert again.contact is None and again.twin_contact == "preloaded"
    assert "contact preloaded, but this twin has" in again.mismatch("gen2", "loaded")
    assert again.mismatch("gen2", "preloaded") is None


@pytest.mark.parametrize("name", ["gen2_gait", "gen2_orifice", "gen4_ilc"])
def test_shipped_footprints_contain_a_hundred_runs_per_plant(name):
    kept = load_footprint_file(name).excursions
    assert {each.conditions.plant for each in kept} == {"analytical", "twin"}
    for each in kept:
        assert len(each.path_m) == 100 and each.path_m == sorted(each.path_m)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("ending", ENDINGS)
def test_only_runs_that_reach_the_goal_count_by_their_excursion(monkeypatch, ending):
    """The run-up ends at 1 s, and the largest excursions before and after it are separate results."""
    time = np.linspace(0.0, 2.0, 9)
    out = np.where(time < 1.0, 0.02, 0.05) * np.sin(time) ** 2
    driven = SimpleNamespace(time=time)
    monkeypatch.setattr(excursions, "rollout", lambda *given, **named: driven)
    monkeypatch.setattr(excursions, "beyond", lambda run: out)
    about = {"plans": [{"time": 0.0}, {"time": 1.0}], "ending": ending}
    monkeypatch.setattr(excursions, "following", lambda run: about)
    document = load_scenario("follow_fig56").document
    straight = {
        "kind": "given",
        "turns_rad": [0.0],
        "step_m": 1.0,
        "footprint": "gen2_gait",
    }
    run = excursions.FollowerRun(
        {**document, "planner": straight, "world": {}, "expect": []},
        0.4,
        "analytical",
        0,
    )
    before, after = run.run()
    assert before == pytest.approx(0.02 * np.sin(0.75) ** 2)
    arrived = ending == "goal_reached"
    assert after == (pytest.approx(0.05 * np.sin(1.5) ** 2) if arrived else LOST_M)
