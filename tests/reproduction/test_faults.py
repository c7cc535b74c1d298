"""A deliberate fault turns rows red: each is put into every scenario that runs, and named rows see it."""

from __future__ import annotations

import copy

import pytest

from srs_twin.reproduction.claims import chosen, load_claims
from srs_twin.reproduction.runs import open_store
from srs_twin.reproduction.verdicts import judge

ROWS = ("gen2-straight", "gen2-top-speed.middle", "gen3-symmetry.left", "act-step-gen4.tau1")


def swapped(robot, document):
    friction = robot["friction"]
    friction["mu_t"]["value"], friction["mu_n"]["value"] = (
        friction["mu_n"]["value"],
        friction["mu_t"]["value"],
    )


def reversed_wave(robot, document):
    robot["gait"]["phase_step_rad"]["value"] *= -1


def slow(robot, document):
    for name in ("tau_fill_s", "tau_vent_s"):
        robot["actuator"][name]["value"] *= 2


def flipped(robot, document):
    controller = document["controller"]
    controller["offset"] = -controller.get("offset", 0.0)


def none(robot, document):
    pass


def verdicts(fault, names, folder):
    """Judge rows with a fault in whatever they run."""

    def altered(document):
        document = copy.deepcopy(dict(document))
        fault(document["robot"], document)
        return document

    claims = chosen(load_claims(), tuple(names), quick=True)
    with open_store(folder, altered) as store:
        found = judge(claims, store, workers=1)
    return {
        (row.claim.id, column): outcome.verdict for row in found for column, outcome in row.outcomes.items()
    }


@pytest.mark.slow
def test_without_a_fault_they_are_green(tmp_path):
    assert set(verdicts(none, ROWS, tmp_path).values()) == {"met"}


@pytest.mark.parametrize(
    ("fault", "row"),
    [
        (swapped, "gen2-top-speed.middle"),
        pytest.param(reversed_wave, "gen2-top-speed.middle", marks=pytest.mark.slow),
        (slow, "act-step-gen4.tau1"),
        pytest.param(flipped, "gen3-symmetry.left", marks=pytest.mark.slow),
    ],
)
def test_a_fault_turns_rows_red(fault, row, tmp_path):
    found = verdicts(fault, [row], tmp_path)
    assert {column for _, column in found} == {"analytical", "twin"}
    assert set(found.values()) == {"missed"}, found
