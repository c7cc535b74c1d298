"""Function that checks the dissertation's claims on both plants and writes reports."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from srs_twin.cli.junit import TestCase, write_report
from srs_twin.errors import InputError
from srs_twin.io.arguments import checked
from srs_twin.io.file_sets import replace_files
from srs_twin.io.files import StrPath, folder_or_temporary
from srs_twin.reproduction import verdicts
from srs_twin.reproduction.claims import Claim, load_claims, select_claims
from srs_twin.reproduction.figures import (
    FigureEntry,
    draw_figures,
    figure_jobs,
    load_figures,
)
from srs_twin.reproduction.report import outcome_text, write_html, write_json
from srs_twin.reproduction.runs import HTML, JSON, JUNIT, open_store
from srs_twin.reproduction.verdicts import (
    MET,
    ClaimOutcome,
    JudgedClaim,
    judge,
    load_baseline,
)
from srs_twin.studies.sweep.execution import Progress, quiet


@dataclass(frozen=True)
class Reproduction:
    """Verdicts on the claims of the dissertation.

    Attributes:
        rows: claims with their outcomes.
        changes: descriptions of verdicts that differ from the baseline.
    """

    rows: tuple[JudgedClaim, ...]
    changes: tuple[str, ...]


@checked
def reproduce(
    only: Sequence[str] = (),
    *,
    quick: bool = False,
    out: StrPath | None = None,
    workers: int | None = None,
    figures: bool = True,
    write_baseline: bool = False,
    progress: Progress = quiet,
) -> Reproduction:
    """Check the dissertation's claims on both plants, as `srs-twin reproduce` does.

    Args:
        only: names of claims, or the parts of names before a dot. An empty sequence
            selects all claims.
        quick: whether to check only the claims that need short runs.
        out: output folder for reports and finished runs, or None to keep no files.
        workers: number of parallel runs, by default one per processor.
        figures: whether to draw figures.
        write_baseline: whether to store the verdicts as the new baseline.
        progress: function that is called to report the progress of the runs.

    Raises:
        InputError: a claim does not exist, the folder is not usable, or
            `write_baseline` is combined with `only` or `quick`.
    """
    if write_baseline and (only or quick):
        raise InputError("--write-baseline needs all rows; remove --only and --quick")
    claims = select_claims(load_claims(), tuple(only), quick=quick)
    drawn: list[tuple[FigureEntry, Figure]] = []
    with folder_or_temporary(out) as folder, open_store(folder) as store:
        rows = judge(claims, store, workers=workers, progress=progress)
        if figures:
            entries = load_figures()
            if not (only or quick):
                jobs = figure_jobs(entries, store)
                store.run(jobs, "runs for figures", workers=workers, progress=progress)
            drawn = list(draw_figures(entries, store))
        if write_baseline:
            verdicts.write_baseline(rows)
        changes = load_baseline().changes(rows)
        with replace_files(folder, (JSON, HTML, JUNIT)) as fresh:
            write_report(fresh / JUNIT, "srs-twin reproduce", _test_suites(rows))
            write_html(fresh / HTML, rows, drawn, changes)
            write_json(fresh / JSON, rows, changes)
    return Reproduction(rows, tuple(changes))


def _test_suites(rows: Sequence[JudgedClaim]) -> Iterator[tuple[str, list[TestCase]]]:
    for use in dict.fromkeys(row.claim.use for row in rows):
        cases = [
            _test_case(row.claim, column, outcome)
            for row in rows
            if row.claim.use == use
            for column, outcome in row.outcomes.items()
        ]
        yield use, cases


def _test_case(claim: Claim, column: str, outcome: ClaimOutcome) -> TestCase:
    if outcome.verdict == MET:
        return TestCase(claim.id, column)
    message = (
        f"{claim.id}, {column}: {outcome_text(outcome)}, allowed {claim.allowed_text}"
    )
    text = "\n".join([claim.says, claim.source, outcome.why])
    return TestCase(claim.id, column, 0.0, "failure", message, outcome.verdict, text)
