"""Claims file: bounds and uses of its rows, and messages for invalid files."""

from __future__ import annotations

import re

import pytest
from conftest import ROOT

from srs_twin.attribution import PlantVariants
from srs_twin.errors import InputFileError, UnknownNameError
from srs_twin.reproduction.claims import load_claims, select_claims
from srs_twin.scenario.loading import load_scenario

pytestmark = pytest.mark.fast

CLAIMS = load_claims()

LAW_CLAIMS = {
    "friction-spring-car",
    "gen1-no-turn",
    "gen2-straight",
    "gen3-symmetry",
    "gen3-frequency-trend",
    "table9",
    "plan-example",
}
HOLDOUTS = {
    "gen1-forward",
    "gen1-shape-rms",
    "gen2-top-speed",
    "gen2-turn-rate",
    "gen3-speed",
    "smc-direct-step",
    "smc-6hz-amplitude",
    "smc-valves-6hz",
    "ilc-straight",
    "follow-sim",
    "experiments",
}


def rows_of(claim):
    """Return the rows of a claim."""
    return [row for row in CLAIMS if row.id == claim or row.id.startswith(f"{claim}.")]


def test_bounds_of_every_row_are_those_of_the_committed_table():
    """A changed bound must be changed in bounds.csv by hand, in the same commit."""
    header, *expected = (
        (ROOT / "tests/reproduction/bounds.csv").read_text("utf-8").splitlines()
    )
    assert header == "id,low,high"
    assert [
        f"{row.id},{row.allowed.low:.9g},{row.allowed.high:.9g}" for row in CLAIMS
    ] == expected


def test_uses_are_the_original_ones():
    assert all(
        row.use == "law"
        for claim in LAW_CLAIMS
        for row in rows_of(claim)
        if row.id != "table9.larger"
    )
    assert all(
        row.use in ("holdout", "law", "shape")
        for claim in HOLDOUTS
        for row in rows_of(claim)
    )
    table = {row.id: row.use for row in rows_of("table8")}
    fitted = {name for name, use in table.items() if use == "fit"}
    columns = ("speed", "radius", "left", "right")
    repeated = {"table8.right.p01", "table8.right.p02", "table8.left.m02"}
    assert fitted == repeated | {
        f"table8.{column}.{setting}"
        for column in columns
        for setting in ("0", "p03", "m03")
    }
    assert len(table) == 28


def test_table_rows_have_the_sign_of_their_offset():
    rows = {row.id: row for row in CLAIMS}
    right = rows["table8.radius.m02"]
    assert (right.value, right.all_measures[0].where) == (
        -0.8445,
        {"controller.offset": -0.2},
    )
    assert right.allowed == pytest.approx((-1.2 * 0.8445, -0.8 * 0.8445))


def slugs(page):
    """Return the anchors of a Markdown page as hosting sites make them."""
    headings = re.findall(r"^#+ (.*)$", (ROOT / page).read_text("utf-8"), re.M)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        for heading in headings
    }


def test_causes_name_existing_sections_and_switches():
    switches = {
        switch.name
        for switch in PlantVariants(load_scenario("gen3_straight")).all_switches
    }
    causes = [cause for row in CLAIMS for cause in row.cause]
    # The supply flow is an assumption of both plants, so it is no switch between them.
    assert {cause.switch for cause in causes if cause.switch} <= switches | {
        "supply flow"
    }
    for docs in {cause.docs for cause in causes if cause.docs}:
        page, _, anchor = docs.partition("#")
        assert (ROOT / page).is_file(), docs
        assert not anchor or anchor in slugs(page), docs


def test_rows_are_selected_by_name_prefix_with_laws_first():
    rows = select_claims(CLAIMS, ("gen2-radius", "gen2-straight"), quick=False)
    assert [row.use for row in rows] == ["law", "shape", "shape", "shape"]
    assert all(row.quick for row in select_claims(CLAIMS, (), quick=True))
    with pytest.raises(UnknownNameError, match="did you mean gen2-radius"):
        select_claims(CLAIMS, ("gen2-radios",), quick=False)


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
    ("old", "new", "message"),
    [
        (
            "use: holdout",
            "use: guess",
            "4:8: [0].use: must be one of fit, holdout, law, shape",
        ),
        (
            "  rule: near\n",
            "",
            "`rule` is missing; it must be near, below, above or ordering",
        ),
        ("  tol: 0.1\n", "", "the rule near needs either `tol` or `abs`"),
        (
            "gen2_straight",
            "gen2_strait",
            "unknown scenario 'gen2_strait'; did you mean gen2_straight?",
        ),
        (
            "com_speed_m_s",
            "trace.tail_drif",
            "unknown trace 'tail_drif'; did you mean tail_drift?",
        ),
        ("  value: 0.2\n", "", "the rule near needs a `value`"),
        ("  measure:", "  mesure:", "unknown key; did you mean measure?"),
        (
            "scenario: gen2_straight",
            "scenario: x, computation: y",
            "give exactly one of the keys `scenario`, `sweep` and `computation`",
        ),
        ("value: 0.2", "value: .nan", "must be a number"),
        ("- id: one", f"{ROW}- id: one", "the row one is listed 2 times; list it once"),
        (ROW, "{}\n", "must be a list of claims"),
        (
            '  could_fail: "Yes: a slower robot misses"\n',
            "",
            "`could_fail` must be given either here ('Yes: …' or 'No: …')",
        ),
        (
            "Yes: a slower",
            "Perhaps a slower",
            "`could_fail` must begin with 'Yes: ' or 'No: '",
        ),
        (
            "  tolerance: ours\n",
            "",
            "`tolerance` is required for each holdout and not allowed for other uses",
        ),
        (
            "use: holdout",
            "use: shape",
            "required for each holdout and not allowed for other uses",
        ),
        (
            '"Yes: a slower robot misses"\n  tolerance: ours',
            '"No: by symmetry"\n  tolerance: measurement',
            "a headline prediction must be able to fail",
        ),
    ],
)
def test_an_invalid_file_is_refused_with_a_message(old, new, message, tmp_path):
    path = tmp_path / "claims.yaml"
    path.write_text(ROW)
    assert [row.id for row in load_claims(path)] == ["one"]
    path.write_text(ROW.replace(old, new, 1))
    with pytest.raises(InputFileError, match=re.escape(message)):
        load_claims(path)
