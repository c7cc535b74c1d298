"""Table of all parsers of untrusted files; the tests and the fuzzer iterate over it."""

# ruff: noqa: E501 - a table

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import malformed_archives
import malformed_json
import malformed_parquet
import malformed_scenarios as scenarios
import malformed_studies as studies
import malformed_tables as tables
from harness import Malformed, Parser
from malformed_yaml import STRUCTURE, arbitrary_values, edited, not_numbers
from pydantic import BaseModel

from srs_twin.envs.policy import load_policy
from srs_twin.identification.fit_file import FitFile, load_fit
from srs_twin.io.files import shipped_folder
from srs_twin.io.saved_state import SavedState
from srs_twin.io.untrusted import read_json
from srs_twin.robot.file import RobotFile, load_robot_file
from srs_twin.scenario.file import with_extensions
from srs_twin.scenario.loading import load_scenario
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.points import SweepFile
from srs_twin.trajectory import Trajectory

ROBOT = (shipped_folder("robot") / "gen2.yaml").read_bytes()
# Name or path in place of a robot or scenario → part of the message.
REFERENCES = {
    "/dev/zero": "not a regular file",
    "/dev/tty": "not a regular file",
    "/": "a folder; give one file",
    "../../none/../../passwd.yaml": "no such file",
    "./none.yaml": "no such file",
    "x/" * 2000 + "x.yaml": "",
    "/proc/self/mem": "",
    "gen22": "unknown {} 'gen22'",
    "'a\\0b.yaml'": "",
    '"a\\0b.yaml"': "",
    "[gen2]": "",
    "{base: /dev/zero}": "",
    "~": "",
    "1": "",
}


def references(key: str, name: str, good: bytes) -> tuple[Malformed, ...]:
    """Return files with invalid references to a robot or scenario."""
    old = f"{key}: {name}"
    line = good.decode().split(old)[0].count("\n") + 1
    return edited(
        good,
        [
            (old, f"{key}: {new}", text.format(key) or f":{line}:")
            for new, text in REFERENCES.items()
        ],
    )


def yaml_parser(
    name: str,
    good: bytes,
    parse: Callable[[Path], Any],
    model: type[BaseModel],
    malformed: tuple[Malformed, ...],
    **fields: Any,
) -> Parser:
    """Return a parser of YAML files that a model validates."""
    return Parser(
        name,
        ".yaml",
        good,
        parse,
        malformed,
        arbitrary_values(good, model.model_fields),
        **fields,
    )


def scenario_parser(
    name: str,
    good: bytes,
    malformed: tuple[Malformed, ...],
    command: str = "run {}",
) -> Parser:
    """Return a parser of scenario files with one kind of controller."""
    return yaml_parser(
        name, good, load_scenario, with_extensions(), malformed, command=command
    )


S = scenarios
T = studies
P = malformed_parquet
J = malformed_json
A = malformed_archives
PARSERS: tuple[Parser, ...] = (
    scenario_parser(
        "scenario",
        S.SCENARIO,
        STRUCTURE
        + not_numbers(S.SCENARIO, "frequency_hz", "controller.frequency_hz")
        + references("robot", "gen2", S.SCENARIO),
    ),
    scenario_parser("bench", S.BENCH, S.BENCH_MALFORMED),
    scenario_parser("learning", S.LEARNING, S.LEARNING_MALFORMED),
    scenario_parser("following", S.FOLLOWING, S.FOLLOWING_MALFORMED, "plan {}"),
    yaml_parser(
        "robot",
        ROBOT,
        load_robot_file,
        RobotFile,
        STRUCTURE
        + not_numbers(
            ROBOT, r"damping_time_s: \{value", "bending.damping_time_s.value"
        ),
        command="models export {}",
    ),
    yaml_parser(
        "sweep",
        T.SWEEP,
        load_sweep,
        SweepFile,
        STRUCTURE
        + not_numbers(T.SWEEP, "from", "vary.controller.frequency_hz.from")
        + references("scenario", "gen2_straight", T.SWEEP)
        + T.SWEEP_MALFORMED,
        command="sweep {}",
    ),
    yaml_parser(
        "fit",
        T.FIT,
        load_fit,
        FitFile,
        STRUCTURE
        + not_numbers(T.FIT, "independent_samples", "quality.independent_samples")
        + T.FIT_MALFORMED,
        function="srs_twin.identification.fit_file:load_fit",
    ),
    Parser(
        "trajectory",
        ".parquet",
        P.GOOD,
        Trajectory.from_parquet,
        P.MALFORMED,
        P.VALUES,
        function="srs_twin.trajectory:Trajectory.from_parquet",
        same=P.same,
    ),
    Parser(
        "JSON",
        ".json",
        J.GOOD,
        read_json,
        J.MALFORMED,
        J.VALUES,
        function="srs_twin.io.untrusted:read_json",
    ),
    Parser(
        "policy",
        ".npz",
        A.archive(A.POLICY),
        load_policy,
        A.POLICY_MALFORMED,
        A.POLICY_VALUES,
        function="srs_twin.envs.policy:load_policy",
        same=lambda one, other: repr(one) == repr(other),
    ),
    Parser(
        "saved state",
        ".npz",
        A.archive(A.STATE),
        SavedState.read,
        A.STATE_MALFORMED,
        A.STATE_VALUES,
        function="srs_twin.io.saved_state:SavedState.read",
        same=lambda one, other: repr(one) == repr(other),
    ),
    *(
        Parser(
            name,
            ".csv",
            good,
            parse,
            malformed,
            tables.values(good),
            function=function,
            same=tables.same,
        )
        for name, good, parse, malformed, function in tables.TABLES
    ),
)
