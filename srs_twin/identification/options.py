"""Options of the fitting commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from srs_twin.cli.options import JsonOption, QuietOption, argument, option

FITS = "calibration/fits"
"""Default folder of fit files."""

FilesArgument = Annotated[list[str], argument("FILE", "Recordings or tables to fit.")]
RobotOption = Annotated[str, option("--robot -r ROBOT", "Initial robot, shipped or a file.")]

_VALIDATE = "Recording or table for validation, not used by the fit (repeatable)."
ValidateOption = Annotated[list[str] | None, option("--validate FILE", _VALIDATE)]

_FIND = "Parameters to fit, e.g. friction.mu_t,friction.mu_n."
FindOption = Annotated[str | None, option("--find NAMES", _FIND)]


@dataclass(frozen=True)
class FitOptions:
    """Output files of a fit, and how it is reported.

    Options:
        name: Name of the fit and its file. [default: ROBOT_WHAT]
        out: Fit file. [default: calibration/fits/NAME.yaml]
        overwrite: Replace an existing fit that another command wrote.
    """

    name: Annotated[str | None, option("--name NAME")] = None
    out: Annotated[str | None, option("--out FILE.yaml")] = None
    overwrite: Annotated[bool, option("--overwrite")] = False
    quiet: QuietOption = False
    as_json: JsonOption = False
