"""judge(): every row in every column: what came out, met or missed, and why as far as known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from srs_twin.reproduction.claims import Cause, Claim
from srs_twin.reproduction.execution import Progress, Store
from srs_twin.reproduction.outcomes import EXPLAINED, MET, Bench, Judged, Outcome
from srs_twin.reproduction.runs import Order, Orders

Planned = Callable[[int], None]


def judge(
    claims: Sequence[Claim],
    store: Store,
    orders: Orders,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
    planned: Planned | None = None,
) -> tuple[Judged, ...]:
    """Run what rows need and is not there yet, and judge them; then run what may explain those missed.

    Args:
        claims: the rows.
        store: what was run before, and where new runs are kept.
        orders: makes the orders, with whatever is altered in them.
        workers: how many processes; default one a processor.
        progress: called with every run that is finished.
        planned: called with the number of runs that are due, before each round.

    Raises:
        InputError: a scenario or sweep cannot be used, or results cannot be kept.
    """

    def run(wanted: Sequence[Order]) -> None:
        # What stands under a key may have been replaced by an order that also keeps its trajectories.
        keys = dict.fromkeys(order.key for order in wanted)
        due = store.missing(orders.made[key] for key in keys)
        if planned is not None and due:
            planned(len(due))
        store.run(due, workers=workers, progress=progress)

    bench = Bench(store, orders)
    run([order for claim in claims for measure in claim.measures for order in orders.of(measure)])
    rows = [Judged(each, {name: bench.outcome(each, name) for name in each.columns}) for each in claims]
    run(
        [
            order
            for row in rows
            for cause in _to_be_shown(row)
            for measure in row.claim.measures
            for order in orders.of(measure, cause.changes)
        ]
    )
    return tuple(
        replace(row, outcomes={k: _explained(bench, row.claim, k, each) for k, each in row.outcomes.items()})
        for row in rows
    )


def _to_be_shown(row: Judged) -> list[Cause]:
    """Return the causes that runs must show, of the columns that are missed."""
    missed = {name for name, outcome in row.outcomes.items() if outcome.verdict != MET}
    return [cause for cause in row.claim.causes if cause.switch is not None and missed & set(cause.columns)]


def _explained(bench: Bench, claim: Claim, column: str, outcome: Outcome) -> Outcome:
    """Return a missed outcome with the first cause that is shown, or with what was thought to be one."""
    causes = [cause for cause in claim.causes if column in cause.columns]
    if outcome.verdict == MET or not causes:
        return outcome
    for cause in causes:
        if cause.docs is not None:
            return replace(outcome, verdict=EXPLAINED, why=f"{cause.says} ({cause.docs})")
        if cause.switch is None:
            return replace(outcome, why=f"supposed: {cause.says}")
        switched = bench.outcome(claim, column, cause.changes)
        if switched.verdict == MET:
            return replace(outcome, verdict=EXPLAINED, why=f"{cause.switch}: {cause.says}; met without it")
    tried = ", ".join(f"{cause.switch}" for cause in causes)
    return replace(outcome, why=outcome.why or f"not met either with {tried} switched")
