"""Write the tables of docs/reproduction.md from the committed baseline.

uv run srs-twin reproduce --write-baseline   # runs everything, writes calibration/published/baseline.json
uv run python docs/reproduction.py           # writes the page from it
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from srs_twin.io.files import atomic_write
from srs_twin.reproduction.claims import Category, Claim, load_claims
from srs_twin.reproduction.report import (
    MEANINGS,
    TITLES,
    by_category,
    count_verdicts,
    outcome_text,
    published_text,
)
from srs_twin.reproduction.verdicts import (
    EXPLAINED,
    MET,
    MISSED,
    Baseline,
    ClaimOutcome,
    JudgedClaim,
    load_baseline,
)

PAGE = Path(__file__).with_name("reproduction.md")
NAME = "reproduction"
CAUSES = "Causes:"
COMPLETE: tuple[Category, ...] = ("headline",)
"""Categories of which the page lists all rows, not only the rows that are not met."""
COUNTED: tuple[Category, ...] = ("fit",)
"""Categories of which the page states only the counts, because they are no evidence."""


def judged_claims(
    claims: Sequence[Claim], baseline: Baseline
) -> tuple[JudgedClaim, ...]:
    """Return the claims with the outcomes of the baseline."""
    return tuple(
        JudgedClaim(claim, baseline.outcomes.get(claim.id, {})) for claim in claims
    )


def markdown(rows: Sequence[JudgedClaim]) -> str:
    """Return the tables of docs/reproduction.md: one section per category, with the causes of its misses."""
    sections = []
    for name, chosen in by_category(rows).items():
        listed = [row for row in chosen if name in COMPLETE or not _is_met(row)]
        if not listed or name in COUNTED:
            continue
        lines = [
            f"### {TITLES[name]}",
            "",
            MEANINGS[name],
            "",
            "| row | statement | published | analytical | twin |",
            "| --- | --- | --- | --- | --- |",
            *map(_line, listed),
        ]
        reasons = _reasons(chosen)
        sections.append("\n".join(lines))
        if reasons:
            sections.append("\n".join([CAUSES, "", *reasons]))
    return "\n\n".join(sections)


def table(rows: Sequence[JudgedClaim]) -> str:
    """Return the table of the counts: rows met by category, headline first."""
    columns = {
        "twin": "twin",
        "analytical": "analytical model",
        "alone": "without a plant",
    }
    lines = [f"{len(rows)} rows in total; the table counts the rows that are met:", ""]
    lines += [f"| rows | {' | '.join(columns.values())} |"]
    lines += [f"|{' --- |' * (len(columns) + 1)}"]
    for name, chosen in by_category(rows).items():
        counts = [count_verdicts(chosen, column) for column in columns]
        cells = [
            f"{counted[MET]} of {counted['all']}" if counted["all"] else ""
            for counted in counts
        ]
        title = f"**{TITLES[name]}**" if name == "headline" else TITLES[name]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _is_met(row: JudgedClaim) -> bool:
    return all(outcome.verdict == MET for outcome in row.outcomes.values())


def _line(row: JudgedClaim) -> str:
    claim = row.claim
    unit = "" if claim.unit == "1" or claim.value is None else f" {claim.unit}"
    cells = [_marked(row.outcomes.get(name)) for name in ("analytical", "twin")]
    if "alone" in row.outcomes:
        cells = [_marked(row.outcomes["alone"]), ""]
    statement = f"{claim.says} ({claim.source})"
    texts = [
        f"`{claim.id}`",
        statement,
        f"{published_text(claim)}{unit}",
        *cells,
    ]
    return f"| {' | '.join(texts)} |".replace("\n", " ")


def _marked(outcome: ClaimOutcome | None) -> str:
    if outcome is None:
        return ""
    mark = {MET: "", EXPLAINED: "*", MISSED: "**"}[outcome.verdict]
    return f"{mark}{outcome_text(outcome)}{mark}"


def _reasons(rows: Sequence[JudgedClaim]) -> list[str]:
    columns_of: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        for column, outcome in row.outcomes.items():
            if outcome.verdict != MET and outcome.why:
                reason = f"{outcome.verdict}: {outcome.why}"
                columns_of.setdefault((row.claim.id, reason), []).append(column)
    # Rows with the same cause and the same columns share one line.
    names_of: dict[tuple[str, str], list[str]] = {}
    for (name, reason), columns in columns_of.items():
        names_of.setdefault((", ".join(columns), reason), []).append(f"`{name}`")
    return [
        f"- {', '.join(names)} ({columns}) {reason}"
        for (columns, reason), names in names_of.items()
    ]


def replace_between(page: str, name: str, text: str) -> str:
    """Return a page in which the text between two markers is replaced.

    Args:
        page: page with ``<!-- name: begin -->`` and ``<!-- name: end -->``.
        name: name of the markers.
        text: new text.
    """
    begin = f"<!-- {name}: begin -->"
    end = f"<!-- {name}: end -->"
    before, _, rest = page.partition(begin)
    _, _, after = rest.partition(end)
    return f"{before}{begin}\n{text}\n{end}{after}"


def new_page(rows: tuple[JudgedClaim, ...]) -> str:
    """Return the new text of the page."""
    counted = replace_between(PAGE.read_text("utf-8"), "counts", table(rows))
    return replace_between(counted, NAME, markdown(rows))


def main() -> None:
    """Write the page."""
    rows = judged_claims(load_claims(), load_baseline())
    text = new_page(rows)
    with atomic_write(PAGE) as temporary:
        temporary.write_text(text, "utf-8")


if __name__ == "__main__":
    main()
