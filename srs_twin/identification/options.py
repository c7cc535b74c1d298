"""Options of commands that fit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from srs_twin.cli.options import JsonOption, QuietOption, argument, option

FITS = "calibration/fits"


FilesArgument = Annotated[list[str], argument("FILE", "Recordings or tables that the fit is made from.")]


RobotOption = Annotated[str, option("--robot -r ROBOT", "Where the search starts: shipped, or a file.")]


_VALIDATE = "Held against the fit, which does not see it; repeatable."


ValidateOption = Annotated[list[str] | None, option("--validate FILE", _VALIDATE)]


_FIND = "What to look for, as friction.mu_t,friction.mu_n."


FindOption = Annotated[str | None, option("--find NAMES", _FIND)]


@dataclass(frozen=True)
class FitOptions:
    """Where a fit goes, and whether to be quiet.

    Options:
        name: Of the fit and its file. [default: ROBOT_WHAT]
        out: Its file. [default: calibration/fits/NAME.yaml]
        overwrite: Replace the fit of another command.
    """

    name: Annotated[str | None, option("--name NAME")] = None
    out: Annotated[str | None, option("--out FILE.yaml")] = None
    overwrite: Annotated[bool, option("--overwrite")] = False
    quiet: QuietOption = False
    as_json: JsonOption = False
