"""What a fit found, for the terminal: numbers, intervals, verdicts, correlations, residuals."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import TYPE_CHECKING

from srs_twin.cli import console

if TYPE_CHECKING:
    from srs_twin.identification.estimate import Estimate, Parameter, Role

_WIDTH = 100
_STRONG = 0.5
_MOST_PAIRS = 6
_MOST_SIGNALS = 24


def show(estimate: Estimate) -> None:
    """Print what was found."""
    from rich import box
    from rich.table import Table

    terminal = console()
    terminal.width = max(terminal.width, _WIDTH)  # cut numbers would be wrong numbers
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("parameter", "value", "95 % interval", "unit", "verdict"):
        right = heading in ("value", "95 % interval")
        table.add_column(heading, justify="right" if right else "left", no_wrap=True)
    for each in estimate.parameters:
        table.add_row(*_row(each))
    terminal.print(table)
    for line in (*_reasons(estimate), *correlations(estimate), *cancelling(estimate)):
        terminal.print(line, soft_wrap=True)
    terminal.print(_residuals(estimate), soft_wrap=True)  # a path that is cut is no path
    if not estimate.converged:
        terminal.print("the search did not come to an end")


def _row(each: Parameter) -> tuple[str, ...]:
    if each.value is None:
        return each.name, "–", "", each.unit, each.verdict
    return each.name, f"{each.value:.5g}", f"{each.low:.5g} to {each.high:.5g}", each.unit, each.verdict


def _reasons(estimate: Estimate) -> Iterator[str]:
    yield from (f"{each.name}: {each.why}" for each in estimate.parameters if each.why)


def correlations(estimate: Estimate) -> Iterator[str]:
    """Yield a line for each of the strongest correlations of two estimates."""
    names = [each.name for each in estimate.parameters]
    known = [k for k, each in enumerate(estimate.parameters) if each.value is not None]
    pairs = [(float(estimate.correlation[i, j]), names[i], names[j]) for i, j in combinations(known, 2)]
    strong = sorted((pair for pair in pairs if abs(pair[0]) >= _STRONG), key=lambda pair: -abs(pair[0]))
    yield from (f"correlation {value:+.2f}: {one}, {other}" for value, one, other in strong[:_MOST_PAIRS])


def cancelling(estimate: Estimate) -> Iterator[str]:
    """Yield a line for each direction in which the residuals do not change."""
    for row in estimate.cancels:
        yield "cancels: " + ", ".join(f"{share:+.2f} {name}" for name, share in row.items())


def _unit(unit: str) -> str:
    """Return a unit as it follows a number; the unit 1 does not."""
    return "" if unit == "1" else f" {unit}"


def _residuals(estimate: Estimate) -> str:
    """Return the residuals of the fit and of the validation, signal by signal where these are few."""
    lines = []
    roles: tuple[Role, ...] = ("fit", "validation")
    for role in roles:
        whole = estimate.rms(role)
        if whole is None:
            continue
        of = [each for each in estimate.residuals if each.role == role and len(each.values)]
        lines.append(f"{role}: residuals {whole:.3g} times the expected noise")
        lines += [f"  {each.name}: {each.rms:.3g}{_unit(each.unit)} RMS" for each in of[:_MOST_SIGNALS]]
        if len(of) > _MOST_SIGNALS:
            lines.append(f"  and {len(of) - _MOST_SIGNALS} more signals")
    return "\n".join(lines)
