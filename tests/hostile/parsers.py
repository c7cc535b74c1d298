"""All parsers of files from outside. A new one joins `PARSERS`, and with that every test and the fuzzer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import hostile_bench
import hostile_fits
import hostile_following
import hostile_json
import hostile_learning
import hostile_logs
import hostile_mjcf
import hostile_parquet
import hostile_sweep
import warm
from harness import Identity, Malformed, Parser
from hostile_yaml import STRUCTURE, anything_anywhere, edited, no_numbers
from hypothesis import strategies as st

from srs_twin.identification.fit_file import FitFile, load_fit
from srs_twin.io.documents import dump_yaml, parse_yaml
from srs_twin.io.files import shipped_folder
from srs_twin.io.json_files import read_json
from srs_twin.plants.twin.mjcf.check import check_mjcf
from srs_twin.robot.file import RobotFile, load_robot_file
from srs_twin.scenario.file import ScenarioFile
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.scenario.scenario import Scenario
from srs_twin.studies.sweep.file import SweepFile
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.trajectory import Trajectory

SCENARIO = b"""\
title: Generation 2, straight
robot: gen2
duration_s: 1
supply: {pressure_kpa: 48.3}
controller: {kind: gait, frequency_hz: 2.0, offset: 0.0}
world: {}
plants:
  analytical: {model: complete, friction: axis}
  twin: {wheels: rolling}
expect:
  - {metric: com_speed_m_s, plant: twin, near: 0.214, rel: 0.15, source: Table 10}
"""
NAMES = st.characters(codec="ascii")
# What YAML may hold: control characters are refused there.
TEXT = st.characters(codec="utf-8", exclude_categories=["Cc"])
ROBOT = (shipped_folder("robot") / "gen2.yaml").read_bytes()


def plain_data(text: bytes) -> dict[str, Any]:
    """Return what a YAML file says."""
    data: dict[str, Any] = parse_yaml(text.decode(), "good").data
    return data


def robots_elsewhere(key: str, good: bytes) -> tuple[Malformed, ...]:
    """Return files that name a robot, or a scenario, which must not be opened or is none."""
    old = f"{key}: gen2" if key == "robot" else f"{key}: gen2_straight"
    line = good.decode().split(old)[0].count("\n") + 1
    words = {
        "/dev/zero": "not a regular file", "/dev/tty": "not a regular file", "/": "a folder; give one file",
        "../../none/../../passwd.yaml": "no such file", "./none.yaml": "no such file",
        "x/" * 2000 + "x.yaml": "", "/proc/self/mem": "", "gen22": f"unknown {key} 'gen22'",
        "'a\\0b.yaml'": "", '"a\\0b.yaml"': "", "[gen2]": "", "{base: /dev/zero}": "", "~": "", "1": "",
    }  # fmt: skip
    edits = {f"{key}: {new[:30]}": (old, f"{key}: {new}", said) for new, said in words.items()}
    return tuple(Malformed(each.name, each.content, each.says or f":{line}:") for each in edited(good, edits))


@st.composite
def scenarios(draw: st.DrawFn) -> Scenario:
    """Return any scenario of a few robots."""
    maybe = st.booleans()
    text = st.text(TEXT, min_size=1, max_size=30)
    data: dict[str, Any] = {
        "robot": draw(st.sampled_from(["gen1", "gen2", "gen3", "gen4"])),
        "duration_s": draw(st.integers(1, 3600)),
        "seed": draw(st.integers(0, 2**31)),
        "title": draw(text),
        "allow_overpressure": True,
        "supply": {"pressure_kpa": draw(st.floats(0.1, 2000))},
        "controller": {
            "kind": "gait", "frequency_hz": draw(st.floats(0.01, 50)), "offset": draw(st.floats(-0.95, 0.95)),
            "phase_rad": draw(st.floats(-6.3, 6.3)),
        },
        "start": {"x_m": draw(st.floats(-1000, 1000)), "heading_rad": draw(st.floats(-6.3, 6.3))},
        "pneumatics": draw(
            st.sampled_from([{}, {"kind": "orifice"}, {"leak_per_s": 1e-5, "valve_delay_s": 1e-9}])
        ),
        "plants": {"analytical": draw(st.sampled_from([{}, {"model": "compliant", "friction": "wheel"}]))},
    }  # fmt: skip
    if draw(maybe):
        data["plants"]["twin"] = {"hinges_per_segment": draw(st.integers(1, 4))}
    if draw(maybe):
        data["world"] = {"goal": {"x_m": draw(st.floats(-1000, 1000)), "y_m": 0.0}}
    return parse_scenario(
        data, name=draw(st.from_regex(r"[a-z][\w .+=-]{0,20}", fullmatch=True, alphabet=NAMES))
    )


@st.composite
def robots(draw: st.DrawFn) -> RobotFile:
    """Return gen2 with other words and numbers."""
    data = plain_data(ROBOT)
    for section, key, low, high in (
        ("friction", "mu_t", 0.0, 10.0), ("friction", "mu_n", 0.0, 10.0),
        ("bending", "stiffness_nm_per_rad", 1e-4, 1e6), ("actuator", "tau_fill_s", 1e-6, 100.0),
    ):  # fmt: skip
        data[section][key]["value"] = draw(st.floats(low, high))
        data[section][key]["source"] = words = draw(st.text(TEXT, min_size=1, max_size=40))
        normal = {"kind": st.just("normal"), "sd": st.floats(1e-9, 1e3), "source": st.just(words)}
        data[section][key]["uncertain"] = draw(st.none() | st.fixed_dictionaries(normal))
    data["title"] = draw(st.text(TEXT, min_size=1, max_size=40))
    return RobotFile.model_validate(data)


def yaml_bytes(data: Any) -> bytes:
    """Return what we would write."""
    return dump_yaml(data).encode("utf-8", "surrogatepass")


PARSERS: tuple[Parser, ...] = (
    Parser(
        name="scenario",
        suffix=".yaml",
        good=SCENARIO,
        parse=load_scenario,
        malformed=STRUCTURE + no_numbers(SCENARIO, "frequency_hz", "controller.frequency_hz")
        + robots_elsewhere("robot", SCENARIO),
        values=anything_anywhere(plain_data(SCENARIO), lambda: list(ScenarioFile.model_fields)),
        command=("run", "{}"),
        identity=Identity(scenarios(), lambda scenario: yaml_bytes(scenario.document)),
    ),
    Parser(
        name="bench",
        suffix=".yaml",
        good=hostile_bench.GOOD,
        parse=load_scenario,
        malformed=hostile_bench.MALFORMED,
        values=anything_anywhere(plain_data(hostile_bench.GOOD), lambda: list(ScenarioFile.model_fields)),
        command=("run", "{}"),
        identity=Identity(hostile_bench.benches(), lambda scenario: yaml_bytes(scenario.document)),
    ),
    Parser(
        name="learning",
        suffix=".yaml",
        good=hostile_learning.GOOD,
        parse=load_scenario,
        malformed=hostile_learning.MALFORMED,
        values=anything_anywhere(plain_data(hostile_learning.GOOD), lambda: list(ScenarioFile.model_fields)),
        command=("run", "{}"),
        identity=Identity(hostile_learning.learners(), lambda scenario: yaml_bytes(scenario.document)),
    ),
    Parser(
        name="following",
        suffix=".yaml",
        good=hostile_following.GOOD,
        parse=load_scenario,
        malformed=hostile_following.MALFORMED,
        values=anything_anywhere(plain_data(hostile_following.GOOD), lambda: list(ScenarioFile.model_fields)),
        command=("plan", "{}"),
        identity=Identity(hostile_following.followers(), lambda scenario: yaml_bytes(scenario.document)),
    ),
    Parser(
        name="robot",
        suffix=".yaml",
        good=ROBOT,
        parse=load_robot_file,
        malformed=STRUCTURE + no_numbers(ROBOT, r"damping_time_s: \{value", "bending.damping_time_s.value"),
        values=anything_anywhere(plain_data(ROBOT), lambda: list(RobotFile.model_fields)),
        command=("models", "export", "{}"),
        identity=Identity(robots(), lambda robot: yaml_bytes(robot.model_dump(mode="json"))),
    ),
    Parser(
        name="sweep",
        suffix=".yaml",
        good=hostile_sweep.GOOD,
        parse=load_sweep,
        malformed=STRUCTURE + no_numbers(hostile_sweep.GOOD, "from", "vary.controller.frequency_hz.from")
        + robots_elsewhere("scenario", hostile_sweep.GOOD) + hostile_sweep.MALFORMED,
        values=anything_anywhere(plain_data(hostile_sweep.GOOD), lambda: list(SweepFile.model_fields)),
        command=("sweep", "{}"),
    ),
    Parser(
        name="trajectory",
        suffix=".parquet",
        good=hostile_parquet.GOOD,
        parse=Trajectory.from_parquet,
        function="srs_twin.trajectory:Trajectory.from_parquet",
        malformed=hostile_parquet.MALFORMED,
        values=hostile_parquet.VALUES,
        identity=Identity(hostile_parquet.trajectories(), hostile_parquet.content),
        same=hostile_parquet.same,
    ),
    Parser(
        name="mjcf",
        suffix=".xml",
        good=hostile_mjcf.GOOD,
        parse=lambda path: warm.refused(path, check_mjcf(path)),
        malformed=hostile_mjcf.MALFORMED,
        values=hostile_mjcf.VALUES,
        command=("models", "check", "{}"),
        quick=lambda path: warm.refused(path, warm.check(path)),
    ),
    Parser(
        name="JSON",
        suffix=".json",
        good=hostile_json.GOOD,
        parse=read_json,
        function="srs_twin.io.json_files:read_json",
        malformed=hostile_json.MALFORMED,
        values=hostile_json.VALUES,
        identity=Identity(hostile_json.DATA, lambda data: json.dumps(data).encode()),
    ),
    Parser(
        name="Motive export",
        suffix=".csv",
        good=hostile_logs.MOTIVE,
        parse=hostile_logs.motion,
        function="srs_twin.recordings.formats:read_markers",
        malformed=hostile_logs.MOTIVE_MALFORMED,
        values=hostile_logs.values(hostile_logs.MOTIVE),
        same=hostile_logs.same_motion,
    ),
    Parser(
        name="plain motion",
        suffix=".csv",
        good=hostile_logs.PLAIN,
        parse=hostile_logs.motion,
        function="srs_twin.recordings.formats:read_markers",
        malformed=hostile_logs.PLAIN_MALFORMED,
        values=hostile_logs.values(hostile_logs.PLAIN),
        same=hostile_logs.same_motion,
    ),
    Parser(
        name="valve log",
        suffix=".csv",
        good=hostile_logs.VALVES,
        parse=hostile_logs.valves,
        function="srs_twin.recordings.csv_table:read_file",
        malformed=hostile_logs.VALVE_MALFORMED,
        values=hostile_logs.values(hostile_logs.VALVES),
        same=hostile_logs.same_valves,
    ),
    Parser(
        name="static table",
        suffix=".csv",
        good=hostile_fits.TABLE,
        parse=hostile_fits.table,
        function="srs_twin.recordings.csv_table:read_file",
        malformed=hostile_fits.TABLE_MALFORMED,
        values=hostile_logs.values(hostile_fits.TABLE),
        same=hostile_fits.same_tables,
    ),
    Parser(
        name="fit",
        suffix=".yaml",
        good=hostile_fits.FIT,
        parse=load_fit,
        function="srs_twin.identification.fit_file:load_fit",
        malformed=STRUCTURE + hostile_fits.FIT_MALFORMED
        + no_numbers(hostile_fits.FIT, "independent_samples", "quality.independent_samples"),
        values=anything_anywhere(plain_data(hostile_fits.FIT), lambda: list(FitFile.model_fields)),
        identity=Identity(
            hostile_fits.fits(), lambda fit: yaml_bytes(fit.model_dump(mode="json", exclude_none=True))
        ),
    ),
)  # fmt: skip


def path_of(parser: Parser, folder: Path) -> Path:
    """Return where a file of this kind is put for a test."""
    return folder / f"x{parser.suffix}"
