"""Deliberate faults in the scenarios change the verdicts of rows that are known to detect them."""

from __future__ import annotations

import copy

import pytest

from srs_twin.reproduction.claims import load_claims, select_claims
from srs_twin.reproduction.runs import open_store
from srs_twin.reproduction.verdicts import judge

ROWS = (
    "gen2-straight",
    "gen2-top-speed.middle",
    "gen3-symmetry.left",
    "act-step-gen4.tau1",
)


def swap_friction(robot, document):
    """Swap the tangential and normal friction coefficients."""
    friction = robot["friction"]
    friction["mu_t"]["value"], friction["mu_n"]["value"] = (
        friction["mu_n"]["value"],
        friction["mu_t"]["value"],
    )


def reverse_wave(robot, document):
    """Reverse the direction of the travelling wave."""
    robot["gait"]["phase_step_rad"]["value"] *= -1


def slow_actuator(robot, document):
    """Double both time constants of the actuator."""
    for name in ("tau_fill_s", "tau_vent_s"):
        robot["actuator"][name]["value"] *= 2


def negate_offset(robot, document):
    """Negate the offset of the controller."""
    controller = document["controller"]
    controller["offset"] = -controller.get("offset", 0.0)


def no_fault(robot, document):
    """Change nothing."""


def verdicts(fault, names, folder):
    """Return (claim, column) → verdict with a fault in every scenario that the claims run."""

    def change(document):
        document = copy.deepcopy(dict(document))
        fault(document["robot"], document)
        return document

    claims = select_claims(load_claims(), tuple(names), quick=True)
    with open_store(folder, change) as store:
        rows = judge(claims, store, workers=1)
    return {
        (row.claim.id, column): outcome.verdict
        for row in rows
        for column, outcome in row.outcomes.items()
    }


@pytest.mark.slow
def test_rows_are_met_without_a_fault(tmp_path):
    assert set(verdicts(no_fault, ROWS, tmp_path).values()) == {"met"}


@pytest.mark.parametrize(
    ("fault", "row"),
    [
        (swap_friction, "gen2-top-speed.middle"),
        pytest.param(reverse_wave, "gen2-top-speed.middle", marks=pytest.mark.slow),
        (slow_actuator, "act-step-gen4.tau1"),
        pytest.param(negate_offset, "gen3-symmetry.left", marks=pytest.mark.slow),
    ],
)
def test_a_fault_is_detected_in_both_columns(fault, row, tmp_path):
    outcomes = verdicts(fault, [row], tmp_path)
    assert {column for _, column in outcomes} == {"analytical", "twin"}
    assert set(outcomes.values()) == {"missed"}, outcomes
