"""Table of all parsers of untrusted files; the tests and the fuzzer iterate over it."""

# ruff: noqa: E501 - a table

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import malformed_archives
import malformed_json
import malformed_parquet
import malformed_scenarios as scenarios
import malformed_studies as studies
import malformed_tables as tables
from harness import Malformed, Parser, RoundTrip
from hypothesis import strategies as st
from malformed_yaml import STRUCTURE, arbitrary_values, edited, not_numbers, varied
from pydantic import BaseModel

from srs_twin.envs.policy import load_policy
from srs_twin.identification.fit_file import FitFile, load_fit
from srs_twin.io.documents import dump_yaml
from srs_twin.io.files import shipped_folder
from srs_twin.io.saved_state import SavedState
from srs_twin.io.untrusted import read_json
from srs_twin.robot.file import RobotFile, load_robot_file
from srs_twin.scenario.file import with_extensions
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.points import SweepFile
from srs_twin.trajectory import Trajectory

ROBOT = (shipped_folder("robot") / "gen2.yaml").read_bytes()
_PRIOR = st.none() | scenarios.block(
    kind="normal", sd=st.floats(1e-9, 1e3), source=scenarios.TEXT
)
_RANGES = {
    "friction.mu_t": (0.0, 10.0),
    "friction.mu_n": (0.0, 10.0),
    "actuator.tau_fill_s": (1e-3, 4.0),
    "bending.stiffness_nm_per_rad": (4e-3, 50.0),
}
_ROBOT_VALUES: dict[str, Any] = {"title": scenarios.TEXT}
for _path, (_low, _high) in _RANGES.items():
    _ROBOT_VALUES |= {
        f"{_path}.value": st.floats(_low, _high),
        f"{_path}.source": scenarios.TEXT,
        f"{_path}.uncertain": _PRIOR,
    }

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


def yaml_bytes(data: Any) -> bytes:
    """Return data as a YAML file."""
    return dump_yaml(data).encode("utf-8", "surrogatepass")


def model_bytes(file: BaseModel) -> bytes:
    """Return a model as a YAML file; fits and robots write no keys without a value."""
    return yaml_bytes(file.model_dump(mode="json", exclude_none=True))


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
    data: Any,
    command: str = "run {}",
) -> Parser:
    """Return a parser of scenario files with one kind of controller."""
    round_trip = RoundTrip(
        data.map(partial(parse_scenario, name=name)),
        lambda scenario: yaml_bytes(scenario.document),
    )
    return yaml_parser(
        name,
        good,
        load_scenario,
        with_extensions(),
        malformed,
        command=command,
        round_trip=round_trip,
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
        S.SCENARIOS,
    ),
    scenario_parser("bench", S.BENCH, S.BENCH_MALFORMED, S.BENCHES),
    scenario_parser("learning", S.LEARNING, S.LEARNING_MALFORMED, S.LEARNERS),
    scenario_parser(
        "following", S.FOLLOWING, S.FOLLOWING_MALFORMED, S.FOLLOWERS, "plan {}"
    ),
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
        round_trip=RoundTrip(
            varied(ROBOT, _ROBOT_VALUES).map(RobotFile.model_validate), model_bytes
        ),
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
        round_trip=RoundTrip(T.fits(), model_bytes),
    ),
    Parser(
        "trajectory",
        ".parquet",
        P.GOOD,
        Trajectory.from_parquet,
        P.MALFORMED,
        P.VALUES,
        function="srs_twin.trajectory:Trajectory.from_parquet",
        round_trip=RoundTrip(P.trajectories(), P.content),
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
        round_trip=RoundTrip(J.DATA, lambda data: json.dumps(data).encode()),
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
