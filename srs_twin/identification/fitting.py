"""What the commands that fit share: progress on stderr, where a fit goes, what is shown of it."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from srs_twin.cli.console import console, interruptible, new_table, say
from srs_twin.cli.options import print_json
from srs_twin.cli.progress import Display
from srs_twin.errors import InputError
from srs_twin.identification.options import FITS, FitOptions

if TYPE_CHECKING:
    from srs_twin.identification.estimate import Estimate, Role
    from srs_twin.identification.fit_file import Data, FitFile, Method


class Searching(Display):
    """Tells how often the model was run and how well it fits so far; a `Watch`."""

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        super().__init__(title, quiet=quiet)
        self._runs, self._least = 0, 0.0

    def __call__(self, runs: int, least: float) -> None:
        """Take note of one more run of the model; `least` is the best weighted RMS so far."""
        self._runs, self._least = runs, least
        self._show()

    def _line(self) -> str:
        return f"{self.title}: {self._bar()[2]}"

    def _bar(self) -> tuple[str, None, str]:
        words = f"{self._runs} runs of the model, weighted residuals {self._least:.3g} RMS at best"
        return self.title, None, words


_WIDTH = 100
_STRONG = 0.5
_MOST_PAIRS = 6
_MOST_SIGNALS = 24


def print_table(headings: Sequence[str], rows: Iterable[Sequence[str]], left: Collection[int] = ()) -> None:
    """Print a table, its columns to the right but for those of these places."""
    table = new_table(*headings, left=left)
    for row in rows:
        table.add_row(*row)
    terminal = console()
    terminal.width = max(terminal.width, _WIDTH)  # cut numbers would be wrong numbers
    terminal.print(table)


def show(estimate: Estimate) -> None:
    """Print what was found."""
    from srs_twin.identification.fit_report import parameter_table

    table = parameter_table(estimate.parameters)
    print_table(table.headings[:-1], (row[:-1] for row in table.rows), left=(0, 3, 4))
    terminal = console()
    whys = dict.fromkeys(each.why for each in estimate.parameters if each.why)
    reasons = (
        f"{', '.join(each.name for each in estimate.parameters if each.why == why)}: {why}" for why in whys
    )
    for line in (
        *reasons,
        *correlations(estimate),
        *cancelling(estimate),
        _residuals(estimate),
        *estimate.misfit,
    ):
        terminal.print(line, soft_wrap=True)  # a path that is cut is no path
    if not estimate.converged:
        terminal.print("the search did not come to an end")


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
        for each in of[:_MOST_SIGNALS]:
            unit = "" if each.unit == "1" else f" {each.unit}"
            lines.append(f"  {each.name}: {each.rms:.3g}{unit} RMS")
        if len(of) > _MOST_SIGNALS:
            lines.append(f"  and {len(of) - _MOST_SIGNALS} more signals")
    return "\n".join(lines)


_LONGEST_COMMAND = 2000
NOTHING_WRITTEN = "nothing was written"


def checked_name(name: str, source: str) -> str:
    """Return the name of a file.

    Args:
        name: lower-case letters, digits and _.
        source: what it was given with, for the message.

    Raises:
        InputError: it is none.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,59}", name):
        allowed = "lower-case letters, digits and _, a letter first, 60 at most"
        raise InputError(f"{source}: '{name}' is not allowed; {allowed}")
    return name


@dataclass(frozen=True)
class FitDestination:
    """Where a fit goes.

    Attributes:
        name: of the fit.
        path: of its file; the report lies beside it.
        robot: where the search starts, as it was given.
        command: as it can be typed again.
        quiet: print errors only.
        as_json: print the fit as JSON.
    """

    name: str
    path: Path
    robot: str
    command: str
    quiet: bool
    as_json: bool

    @classmethod
    def of(cls, context: typer.Context, what: str, robot: str, options: FitOptions) -> FitDestination:
        """Return the place, once it is sure that the fit may go there.

        Raises:
            InputError: a name that is none, or the fit of another command is there.
        """
        name, out = options.name, options.out
        source = "--name" if name else f"{'--out' if out else '--robot'} names the fit, without --name"
        given = checked_name(name or (Path(out).stem if out else f"{Path(robot).stem}_{what}"), source)
        path = Path(out) if out else Path(FITS) / f"{given}.yaml"
        if path.suffix not in (".yaml", ".yml"):
            raise InputError(f"--out: {path} is not allowed; a fit file ends in .yaml")
        command = as_typed(context)
        if os.path.lexists(path) and not options.overwrite:
            _refuse_other(path, command)
        from srs_twin.io.files import open_folder

        open_folder(path.parent, (path.name, path.with_suffix(".html").name))
        return cls(given, path, robot, command, options.quiet, options.as_json)

    @contextmanager
    def searching(self) -> Iterator[Searching]:
        """Show how far the search is; an interrupt ends the command, and nothing is written."""
        with interruptible(NOTHING_WRITTEN), Searching(self.name, quiet=self.quiet) as searching:
            yield searching

    def finish(
        self, estimate: Estimate, method: Method, title: str, fitted: Iterable[Data], held: Iterable[Data]
    ) -> None:
        """Write report and fit file, both or neither, and show the result.

        Args:
            estimate: what was found.
            method: of the fit.
            title: one line for people.
            fitted: what the fit was made from.
            held: what it was validated with.
        """
        from srs_twin.identification.fit_file import data_sets, fit_file, write_fit
        from srs_twin.identification.fit_report import fit_report
        from srs_twin.io.file_sets import replaced
        from srs_twin.io.files import shown
        from srs_twin.scenario.provenance import versions

        fit = fit_file(
            estimate,
            name=self.name,
            title=title[:200],
            robot=self.robot,
            method=method,
            command=self.command,
            versions=versions(),
            data=data_sets(fitted, held),
        )
        report = self.path.with_suffix(".html")
        text = fit_report(fit, estimate)
        with replaced(self.path.parent, (self.path.name, report.name)) as fresh:
            (fresh / report.name).write_text(text, "utf-8")
            write_fit(fit, fresh / self.path.name)
        if self.as_json:
            print_json(fit.model_dump(mode="json", exclude_none=True))
        elif not self.quiet:
            show(estimate)
        if not self.quiet:
            say(f"fit in {shown(self.path)}, residuals in {shown(report)}")


def _refuse_other(path: Path, command: str) -> None:
    """Refuse a place where the fit of another command stands, or something else."""
    from srs_twin.identification.fit_file import load_fit
    from srs_twin.io.files import shown

    remedy = "--overwrite replaces it, --name and --out lead elsewhere"
    try:
        there: FitFile = load_fit(path)
    except InputError as error:
        raise InputError(f"{shown(path)}: something stands there that is no fit; {remedy}") from error
    if there.command != command:
        raise InputError(f"{shown(path)}: another fit stands there ({there.command}); {remedy}")


def as_typed(context: typer.Context) -> str:
    """Return a command with all that is not left at its default, as it can be typed again."""
    words = ["srs-twin", *context.command_path.split()[1:]]
    arguments: list[str] = []
    for parameter in context.command.params:
        value: Any = context.params.get(parameter.name or "")
        # These change what is shown or where it goes, not what is found.
        if value in (None, (), [], parameter.default) or parameter.name in ("quiet", "overwrite", "as_json"):
            continue
        values = value if isinstance(value, (list, tuple)) else [value]
        if parameter.param_type_name == "argument":
            arguments += map(str, values)
        elif isinstance(value, bool):
            words.append(parameter.opts[0] if value else (parameter.secondary_opts or parameter.opts)[0])
        else:
            words += [f"{parameter.opts[0]}={each}" for each in values]
    typed = shlex.join([*words[:3], *arguments, *words[3:]])
    return typed if len(typed) <= _LONGEST_COMMAND else typed[: _LONGEST_COMMAND - 1] + "…"


def names_in(text: str | None) -> list[str] | None:
    """Return the names of a list such as friction.mu_t,friction.mu_n; None where there is none."""
    if text is None:
        return None
    names = [each.strip() for each in text.split(",") if each.strip()]
    if not names:
        raise InputError(f"--find: '{text}' names nothing; names such as friction.mu_t,friction.mu_n")
    return names
