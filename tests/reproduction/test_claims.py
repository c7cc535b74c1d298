"""The claims: what was given is there with no tolerance loosened, and a bad file is refused in words."""

from __future__ import annotations

import math
import re

import pytest
from conftest import ROOT

from srs_twin.attribution import Ladder
from srs_twin.errors import InputFileError, UnknownNameError
from srs_twin.reproduction.claims import chosen, load_claims
from srs_twin.scenario.loading import load_scenario

pytestmark = pytest.mark.fast

CLAIMS = load_claims()

# The list that the project began with: claim → relative tolerance, where one was set.
GIVEN = {
    "act-step-gen4": 0.01, "friction-spring-car": 0.03, "gen1-forward": 0.3, "gen1-shape-rms": None,
    "gen1-no-turn": None, "gen1-circles": None, "gen1-grid": None, "gen2-top-speed": 0.15,
    "gen2-ten-times-gen1": None, "gen2-straight": None, "gen2-radius": None, "gen2-fig34": None,
    "gen2-turn-rate": None, "gen3-speed": 0.3, "gen3-symmetry": None, "gen3-frequency-trend": None,
    "gen3-speed-frequency": None, "gen3-yaw": None, "gen3-amplitude-order": None, "gen3-smoothing": None,
    "gen3-sensors": None, "gen3-tail-lift": None, "sensor-linear": None, "sensor-injective": None,
    "module-static": 0.1, "smc-direct-step": 0.25, "smc-iterative-step": 0.25, "smc-6hz-amplitude": None,
    "smc-low-frequency": None, "smc-hold": None, "smc-valves-6hz": 0.3, "smc-valves-2hz": 0.3,
    "smc-leak": None, "ilc-straight": None, "ilc-curve": None, "ilc-growth": None, "table8": 0.2,
    "table9": None, "plan-example": None, "plan-success": None, "follow-sim": None, "experiments": None,
    "follow-causes": None, "table10": None,
}  # fmt: skip
LAWS = {
    "friction-spring-car", "gen1-no-turn", "gen2-straight", "gen3-symmetry", "gen3-frequency-trend", "table9",
    "plan-example",
}  # fmt: skip
HOLDOUTS = {
    "gen1-forward", "gen1-shape-rms", "gen2-top-speed", "gen2-turn-rate", "gen3-speed", "smc-direct-step",
    "smc-6hz-amplitude", "smc-valves-6hz", "ilc-straight", "follow-sim", "experiments",
}  # fmt: skip


def named(claim):
    return [row for row in CLAIMS if row.id == claim or row.id.startswith(f"{claim}.")]


@pytest.mark.parametrize("claim", GIVEN)
def test_what_was_given_is_there(claim):
    assert named(claim)


@pytest.mark.parametrize("claim", [claim for claim, tol in GIVEN.items() if tol is not None])
def test_no_tolerance_is_loosened(claim):
    checked = 0
    for row in named(claim):
        # Rows of our own beside the one given: a correlation, and the plants' difference.
        if not row.value or row.rule == "ordering" or row.unit.startswith("correlation"):
            continue
        for bound in (row.low, row.high):
            if math.isfinite(bound):
                assert abs(bound - row.value) <= GIVEN[claim] * abs(row.value) * (1 + 1e-9), row.id
                checked += 1
    assert checked


def test_the_bounds_of_every_row_are_those_written_down():
    """No command writes the file: who changes a bound changes it there as well, in the same commit."""
    head, *written = (ROOT / "tests/reproduction/bounds.csv").read_text("utf-8").splitlines()
    assert head == "id,low,high"
    assert [f"{row.id},{row.low:.9g},{row.high:.9g}" for row in CLAIMS] == written


def test_uses_are_those_given():
    assert all(row.use == "law" for claim in LAWS for row in named(claim) if row.id != "table9.larger")
    assert all(row.use in ("holdout", "law", "shape") for claim in HOLDOUTS for row in named(claim))
    table = {row.id: row.use for row in named("table8")}
    fitted = {name for name, use in table.items() if use == "fit"}
    columns = ("speed", "radius", "left", "right")
    repeated = {"table8.right.p01", "table8.right.p02", "table8.left.m02"}
    assert fitted == repeated | {f"table8.{what}.{at}" for what in columns for at in ("0", "p03", "m03")}
    assert len(table) == 28


def test_there_are_enough_rows_and_names_are_unique():
    assert len(CLAIMS) >= 50
    assert len({row.id for row in CLAIMS}) == len(CLAIMS)


def test_a_table_gives_a_row_a_number_with_the_sign_of_its_side():
    rows = {row.id: row for row in CLAIMS}
    right = rows["table8.radius.m02"]
    assert (right.value, right.taken[0].where) == (-0.8445, {"controller.offset": -0.2})
    assert (right.low, right.high) == pytest.approx((-1.2 * 0.8445, -0.8 * 0.8445))


def slugs(page):
    """Return the anchors of a Markdown page as hosting sites make them."""
    headings = re.findall(r"^#+ (.*)$", (ROOT / page).read_text("utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def test_causes_name_sections_and_switches_that_there_are():
    switches = {switch.name for switch in Ladder(load_scenario("gen3_straight"))._all_switches()}
    causes = [cause for row in CLAIMS for cause in row.cause]
    # What both plants assume alike is no switch between them.
    assert {cause.switch for cause in causes if cause.switch} <= switches | {"supply flow"}
    for docs in {cause.docs for cause in causes if cause.docs}:
        page, _, anchor = docs.partition("#")
        assert (ROOT / page).is_file(), docs
        assert not anchor or anchor in slugs(page), docs


def test_rows_are_chosen_by_name_and_laws_come_first():
    found = chosen(CLAIMS, ("gen2-radius", "gen2-straight"), quick=False)
    assert [row.use for row in found] == ["law", "shape", "shape", "shape"]
    assert all(row.quick for row in chosen(CLAIMS, (), quick=True))
    with pytest.raises(UnknownNameError, match="did you mean gen2-radius"):
        chosen(CLAIMS, ("gen2-radios",), quick=False)


ROW = """\
- id: one
  source: Table 8
  says: it moves
  use: holdout
  could_fail: "Yes: a slower robot misses"
  tolerance: ours
  rule: near
  value: 0.2
  tol: 0.1
  measure: {scenario: gen2_straight, metric: com_speed_m_s}
"""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("use: holdout", "use: guess", "4:8: [0].use: must be one of fit, holdout, law, shape"),
        ("  rule: near\n", "", "a rule is needed: near, below, above or ordering"),
        ("  tol: 0.1\n", "", "near needs either tol or abs"),
        ("gen2_straight", "gen2_strait", "unknown scenario 'gen2_strait'; did you mean gen2_straight?"),
        ("com_speed_m_s", "trace.tail_drif", "unknown trace 'tail_drif'; did you mean tail_drift?"),
        ("  value: 0.2\n", "", "near needs a value"),
        ("  measure:", "  mesure:", "unknown key; did you mean measure?"),
        ("scenario: gen2_straight", "scenario: x, law: y", "exactly one of scenario, sweep and law"),
        ("value: 0.2", "value: .nan", "must be a number"),
        ("- id: one", f"{ROW}- id: one", "the row one is there 2 times"),
        (ROW, "{}\n", "must be a list of claims"),
        ('  could_fail: "Yes: a slower robot misses"\n', "", "could_fail is needed: 'Yes: …' or 'No: …'"),
        ("Yes: a slower", "Perhaps a slower", "could_fail must begin with 'Yes: ' or 'No: '"),
        ("  tolerance: ours\n", "", "tolerance belongs to every holdout, and to no other use"),
        ("use: holdout", "use: shape", "tolerance belongs to every holdout, and to no other use"),
        ("tolerance: ours", "tolerance: a guess", "must be one of dissertation, measurement, ours"),
        ("use: holdout", "limitation: fitted_robot\n  use: law", "tolerance belongs to every holdout"),
        (
            '"Yes: a slower robot misses"\n  tolerance: ours', '"No: by symmetry"\n  tolerance: measurement',
            "a headline prediction must be able to fail",
        ),
    ],
)  # fmt: skip
def test_a_bad_file_is_refused_in_words(old, new, words, tmp_path):
    path = tmp_path / "claims.yaml"
    path.write_text(ROW)
    assert [row.id for row in load_claims(path)] == ["one"]
    path.write_text(ROW.replace(old, new, 1))
    with pytest.raises(InputFileError, match=re.escape(words)):
        load_claims(path)
