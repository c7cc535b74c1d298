"""Options, progress display and output of the fit commands."""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from srs_twin.cli.console import Display, console, interruptible, new_table, say
from srs_twin.cli.options import (
    JsonOption,
    PressureOption,
    QuietOption,
    argument,
    option,
    print_json,
)
from srs_twin.errors import InputError
from srs_twin.io.files import check_file_name, check_output_folder, display_path
from srs_twin.recordings.commands import ValvesOption

if TYPE_CHECKING:
    from srs_twin.identification.calibration import Calibration
    from srs_twin.identification.estimate import FitEstimate, Role
    from srs_twin.identification.fit_file import FitFile


FITS = "calibration/fits"
"""Default folder of fit files."""

FilesArgument = Annotated[list[str], argument("FILE", "Recordings or tables to fit.")]
RobotOption = Annotated[
    str,
    option(
        "--robot -r ROBOT",
        "Robot that provides the initial values of the fit: name of a shipped robot, or"
        " path of a robot file.",
    ),
]

_VALIDATE = "Recording or table that is used only to validate the fit. Can be repeated."
ValidateOption = Annotated[list[str] | None, option("--validate FILE", _VALIDATE)]

_PARAMETERS = "Names of the parameters to fit, for example friction.mu_t,friction.mu_n."
ParametersOption = Annotated[str | None, option("--parameters NAMES", _PARAMETERS)]


@dataclass(frozen=True)
class DataOptions:
    """Options for the robot, the logs and the validation data of a fit."""

    robot: RobotOption
    valves: ValvesOption = None
    validate: ValidateOption = None
    pressure: PressureOption = None

    def given(self) -> dict[str, object]:
        """Return the options as arguments for the functions in `calibration`."""
        given = asdict(self)
        pressure = given.pop("pressure")
        return given if pressure is None else given | {"supply_pa": 1e3 * pressure}


@dataclass(frozen=True)
class FitOptions:
    """Output files of a fit, and format of the printed result.

    Options:
        --name NAME: Name of the fit and of its file, for example gen2_friction.
            [default: ROBOT_COMMAND]
        --out FILE.yaml: Path of the fit file. [default: calibration/fits/NAME.yaml]
        --overwrite: Replace the fit file even if another command line wrote it.
    """

    name: str | None = None
    out: str | None = None
    overwrite: bool = False
    quiet: QuietOption = False
    as_json: JsonOption = False


class FitProgress(Display):
    """Progress display of a search."""

    def __init__(self, title: str, *, quiet: bool = False) -> None:
        super().__init__(title, quiet=quiet)
        self._runs = 0
        self._smallest_rms = 0.0

    def __call__(self, runs: int, smallest_rms: float) -> None:
        """Show the number of model runs and the smallest weighted RMS so far."""
        self._runs = runs
        self._smallest_rms = smallest_rms
        self._show()

    def _line(self) -> str:
        return f"{self.title}: {self._bar()[2]}"

    def _bar(self) -> tuple[str, None, str]:
        words = (
            f"{self._runs} model runs, smallest weighted RMS {self._smallest_rms:.3g}"
        )
        return self.title, None, words


_TABLE_WIDTH = 100

_STRONG_CORRELATION = 0.5
"""Minimum magnitude of a correlation that is printed."""

_MAX_PAIRS = 6

_MAX_SIGNALS = 24


def print_table(
    headings: Sequence[str], rows: Iterable[Sequence[str]], left: Collection[int] = ()
) -> None:
    """Print a table in which the columns with the indices `left` are left-aligned."""
    table = new_table(*headings, left=left)
    for row in rows:
        table.add_row(*row)
    terminal = console()
    # A truncated number would be misread.
    terminal.width = max(terminal.width, _TABLE_WIDTH)
    terminal.print(table)


def print_estimate(estimate: FitEstimate) -> None:
    """Print the parameters, correlations and residuals of a fit."""
    from srs_twin.identification.fit_report import direction_text, parameter_table

    table = parameter_table((*estimate.parameters, *estimate.derived))
    print_table(table.headings[:-1], (row[:-1] for row in table.rows), left=(0, 3, 4))
    names_by_reason: dict[str, list[str]] = {}
    for parameter in estimate.parameters:
        if parameter.why:
            names_by_reason.setdefault(parameter.why, []).append(parameter.name)
    terminal = console()
    for line in (
        *(f"{', '.join(names)}: {reason}" for reason, names in names_by_reason.items()),
        *_correlation_lines(estimate),
        *(
            f"unidentifiable direction: {direction_text(direction)}"
            for direction in estimate.cancels
        ),
        *_residual_lines(estimate),
        *estimate.misfit,
    ):
        terminal.print(line, soft_wrap=True)  # line breaks would prevent copying a path
    if not estimate.converged:
        terminal.print("the search did not converge")


def _correlation_lines(estimate: FitEstimate) -> Iterator[str]:
    import numpy as np

    matrix = np.triu(np.nan_to_num(estimate.correlation), 1)
    strong = np.argwhere(np.abs(matrix) >= _STRONG_CORRELATION).tolist()
    strong.sort(key=lambda pair: -abs(matrix[*pair]))
    for i, j in strong[:_MAX_PAIRS]:
        one = estimate.parameters[i].name
        other = estimate.parameters[j].name
        yield f"correlation {matrix[i, j]:+.2f}: {one}, {other}"


def _residual_lines(estimate: FitEstimate) -> Iterator[str]:
    roles: tuple[Role, ...] = ("fit", "validation")
    for role in roles:
        total = estimate.rms(role)
        if total is None:
            continue
        residuals = [
            residual
            for residual in estimate.residuals
            if residual.role == role and len(residual.values)
        ]
        yield f"{role}: residuals {total:.3g} times the expected noise"
        for residual in residuals[:_MAX_SIGNALS]:
            unit = "" if residual.unit == "1" else f" {residual.unit}"
            yield f"  {residual.name}: {residual.rms:.3g}{unit} RMS"
        if len(residuals) > _MAX_SIGNALS:
            yield f"  and {len(residuals) - _MAX_SIGNALS} more signals"


NOTHING_WRITTEN = "nothing was written"


class FitOutput:
    """Output of a fit command."""

    def __init__(
        self, context: typer.Context, method: str, robot: str, options: FitOptions
    ) -> None:
        """Check that the output files may be written."""
        from srs_twin.identification.fit_file import check_fit_suffix

        out = options.out
        name = options.name
        origin = "--name"
        if not name and out:
            name = Path(out).stem
            origin = "--out names the fit if --name is not given"
        elif not name:
            name = f"{Path(robot).stem}_{method}"
            origin = "--robot names the fit if --name is not given"
        self._name = check_file_name(name, origin)
        self._path = path = Path(out or f"{FITS}/{self._name}.yaml")
        check_fit_suffix("--out", path)
        self._command = command_line(context)
        if os.path.lexists(path) and not options.overwrite:
            _check_same_command(path, self._command)
        check_output_folder(path.parent, (path.name, path.with_suffix(".html").name))
        self._options = options

    def run(
        self, function: Callable[..., Calibration], files: list[str], **settings: Any
    ) -> None:
        """Call a fit function, write the files, and print the result.

        If the user interrupts the search, no files are written.
        """
        quiet = self._options.quiet
        notify = partial(say, quiet=quiet)
        with (
            interruptible(NOTHING_WRITTEN),
            FitProgress(self._name, quiet=quiet) as progress,
        ):
            result = function(files, notify=notify, progress=progress, **settings)
        fit = result.write(self._path, self._name, self._command)
        if self._options.as_json:
            print_json(fit.model_dump(mode="json", exclude_none=True))
        elif not quiet:
            print_estimate(result.estimate)
        report = display_path(self._path.with_suffix(".html"))
        notify(f"fit written to {display_path(self._path)}, residuals to {report}")
        if result.plateaus is not None:
            from srs_twin.identification.static_tables import write_static_table

            table = self._path.with_suffix(".table.csv")
            write_static_table(result.plateaus, table)
            notify(
                f"{len(result.plateaus.bend)} plateaus written to {display_path(table)}"
            )


def _check_same_command(path: Path, command: str) -> None:
    from srs_twin.identification.fit_file import load_fit

    remedy = "replace it with --overwrite, or choose another file with --name or --out"
    try:
        existing: FitFile = load_fit(path)
    except InputError as error:
        raise InputError(
            f"{display_path(path)}: the file already exists and is not a fit file;"
            f" {remedy}"
        ) from error
    if existing.command != command:
        raise InputError(
            f"{display_path(path)}: the file already contains another fit"
            f" ({existing.command}); {remedy}"
        )


def command_line(context: typer.Context) -> str:
    """Return the command line without output options and default values."""
    words = ["srs-twin", *context.command_path.split()[1:]]
    arguments: list[str] = []
    for parameter in context.command.params:
        value: object = context.params.get(parameter.name or "")
        # Output options do not change the result.
        is_output = parameter.name in ("quiet", "overwrite", "as_json")
        if is_output or value in (None, (), [], parameter.default):
            continue
        values = value if isinstance(value, (list, tuple)) else [value]
        if parameter.param_type_name == "argument":
            arguments += map(str, values)
        elif value is False:
            words.append(parameter.secondary_opts[0])
        elif value is True:
            words.append(parameter.opts[0])
        else:
            words += [f"{parameter.opts[0]}={item}" for item in values]
    from srs_twin.identification.fit_file import short_command

    return short_command(shlex.join([*words[:3], *arguments, *words[3:]]))


def parse_names(text: str) -> list[str]:
    """Return the names in a comma-separated list."""
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise InputError(
            f"--parameters '{text}' contains no parameters; give one or more, for"
            " example friction.mu_t,friction.mu_n"
        )
    return names
