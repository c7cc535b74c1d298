"""What the commands that fit share: options, where a fit goes, what is written and shown."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from srs_twin.cli import INTERRUPTED, say
from srs_twin.cli.searching import Searching
from srs_twin.errors import InputError

if TYPE_CHECKING:
    from srs_twin.identification.data_set import DataSet
    from srs_twin.identification.estimate import Estimate
    from srs_twin.identification.fit_file import FitFile, Method
    from srs_twin.identification.takes import Reading

FITS = "calibration/fits"
_LONGEST_COMMAND = 2000

FilesArgument = Annotated[
    list[str], typer.Argument(metavar="FILE", help="Recordings or tables that the fit is made from.")
]
RobotOption = Annotated[
    str,
    typer.Option(
        "--robot", "-r", metavar="ROBOT", help="Where the search starts: a shipped robot or a file."
    ),
]
ValidateOption = Annotated[
    list[str] | None,
    typer.Option(
        "--validate", metavar="FILE", help="Held against the fit, which does not see it; repeatable."
    ),
]
ValvesOption = Annotated[
    list[str] | None,
    typer.Option(
        "--valves",
        metavar="LOG",
        help="Log of each recording, FILE... first, then --validate. [default: NAME.valves.csv beside it]",
    ),
]
OffsetOption = Annotated[
    float | None,
    typer.Option("--offset", metavar="S", help="What to add to the logs' times. [default: estimated]"),
]
PressureOption = Annotated[
    float | None, typer.Option("--pressure", metavar="KPA", help="Of the supply. [default: the robot's]")
]
FindOption = Annotated[
    str | None,
    typer.Option("--find", metavar="NAMES", help="What to look for, as friction.mu_t,friction.mu_n."),
]
FrequencyOption = Annotated[
    float | None, typer.Option("--frequency", metavar="HZ", help="Of the gait. [default: the valves']")
]
UpOption = Annotated[str, typer.Option("--up", metavar="AXIS", help="Axis of the files that points up.")]
LayoutOption = Annotated[
    str, typer.Option("--layout", metavar="NAME", help="Markers: auto, single, head or pair.")
]
HeadOption = Annotated[
    str | None, typer.Option("--head", metavar="MARKER", help="At the head. [default: where it crawls to]")
]
GapOption = Annotated[
    float | None,
    typer.Option("--longest-gap", metavar="S", help="Longest gap that is filled. [default: 0.2]"),
]
NameOption = Annotated[
    str | None, typer.Option("--name", metavar="NAME", help="Of the fit and its file. [default: ROBOT_WHAT]")
]
OutOption = Annotated[
    str | None,
    typer.Option("--out", metavar="FILE.yaml", help=f"Where the fit goes. [default: {FITS}/NAME.yaml]"),
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace the fit of another command.")]


@dataclass(frozen=True)
class Place:
    """Where a fit goes.

    Attributes:
        name: of the fit.
        path: of its file; the report lies beside it.
        command: as it can be typed again.
        quiet: print errors only.
    """

    name: str
    path: Path
    command: str
    quiet: bool

    @classmethod
    def of(
        cls, context: typer.Context, what: str, robot: str, name: str | None, out: str | None, *,
        overwrite: bool, quiet: bool,
    ) -> Place:  # fmt: skip
        """Return the place, once it is sure that the fit may go there.

        Raises:
            InputError: a name that is none, or the fit of another command is there.
        """
        given = name or (Path(out).stem if out else f"{Path(robot).stem}_{what}")
        if not re.fullmatch(r"[a-z][a-z0-9_]{0,59}", given):
            source = "--name" if name else f"{'--out' if out else '--robot'} names the fit, without --name"
            raise InputError(
                f"{source}: '{given}' is not allowed; lower-case letters, digits and _, a letter first, 60 "
                "at most"
            )
        path = Path(out) if out else Path(FITS) / f"{given}.yaml"
        if path.suffix not in (".yaml", ".yml"):
            raise InputError(f"--out: {path} is not allowed; a fit file ends in .yaml")
        command = as_typed(context)
        if path.exists() and not overwrite:
            _refuse_other(path, command)
        from srs_twin.folders import open_folder

        open_folder(path.parent, (path.name, path.with_suffix(".html").name))
        return cls(given, path, command, quiet)

    @contextmanager
    def searching(self) -> Iterator[Searching]:
        """Show how far the search is; an interrupt ends the command, and nothing is written.

        Raises:
            typer.Exit: it was interrupted.
        """
        try:
            with Searching(self.name, quiet=self.quiet) as searching:
                yield searching
        except KeyboardInterrupt:
            say("interrupted; nothing was written")
            raise typer.Exit(INTERRUPTED) from None

    def finish(
        self, estimate: Estimate, *, title: str, robot: str, method: Method, data: Sequence[DataSet]
    ) -> None:
        """Write report and fit file, the fit last, and show what was found."""
        from srs_twin.cli.fit_table import show
        from srs_twin.files import atomic_write, shown
        from srs_twin.identification.fit_file import fit_file, write_fit
        from srs_twin.provenance import versions
        from srs_twin.viewing.fit_report import fit_report

        fit = fit_file(
            estimate, name=self.name, title=title[:200], robot=robot, method=method, command=self.command,
            versions=versions(), data=data,
        )  # fmt: skip
        report = self.path.with_suffix(".html")
        text = fit_report(fit, estimate)
        with atomic_write(report) as part:
            part.write_text(text, encoding="utf-8")
        write_fit(fit, self.path)
        if not self.quiet:
            show(estimate)
            say(f"fit in {shown(self.path)}, residuals in {shown(report)}")


def _refuse_other(path: Path, command: str) -> None:
    """Refuse a place where the fit of another command stands, or something else."""
    from srs_twin.files import shown
    from srs_twin.identification.fit_file import load_fit

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
        if value in (None, (), [], parameter.default) or parameter.name in ("quiet", "overwrite"):
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


def reading(
    *,
    up: str = "auto",
    layout: str = "auto",
    head: str | None = None,
    longest_gap: float | None = None,
    offset: float | None = None,
    frequency: float | None = None,
) -> Reading:
    """Return how recordings are read."""
    from srs_twin.identification.recording import LONGEST_GAP
    from srs_twin.identification.takes import Reading

    longest = LONGEST_GAP if longest_gap is None else longest_gap
    return Reading(up, layout, head, longest, offset, frequency)


def names_in(text: str | None) -> list[str] | None:
    """Return the names of a list such as friction.mu_t,friction.mu_n; None where there is none."""
    if text is None:
        return None
    names = [each.strip() for each in text.split(",") if each.strip()]
    if not names:
        raise InputError(f"--find: '{text}' names nothing; names such as friction.mu_t,friction.mu_n")
    return names
