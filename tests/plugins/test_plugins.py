"""Parts from outside the package: plug-in files and installed distributions, and what is refused."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from outside import (
    CONTROLLER,
    FORMAT,
    METRICS,
    PARTS,
    SCENARIO,
    SECTION,
    install,
    tagged_recording,
)

import srs_twin as srs
from srs_twin.envs.tasks import make_task
from srs_twin.errors import InputError, TaskFailedError
from srs_twin.experiment import PreparedRun, load_run, run_scenario
from srs_twin.extensions import PLUGINS, allow_plugin, owners, plugins
from srs_twin.recordings.formats import identify, read_markers
from srs_twin.scenario.loading import (
    load_scenario,
    parse_scenario,
    scenario_json_schema,
)
from srs_twin.scenario.provenance import run_provenance
from srs_twin.studies.sweep.execution import local, open_sweep
from srs_twin.studies.sweep.loading import load_sweep

names = iter(range(1000))


@pytest.fixture(autouse=True)
def alone(monkeypatch):
    """Forget the plug-ins of a test, and the modules that it imported."""
    monkeypatch.setenv(PLUGINS, "")
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if name.startswith(("outside_", "antigravity", "turtle", "pdb")):
            sys.modules.pop(name)


@pytest.fixture
def plugin(tmp_path):
    """Return a function that writes a plug-in and returns its file; each has another name."""

    def write(*sources: str) -> Path:
        path = tmp_path / f"outside_{next(names)}.py"
        path.write_text(
            "".join(sources).replace("from __future__ import annotations\n", "")
        )
        return path

    return write


def document(kind: str, **keys: object) -> dict[str, object]:
    controller = {"kind": kind, "frequency": 2.0, **keys}
    return {"robot": "gen2", "duration_s": 0.4, "controller": controller}


def gait() -> dict[str, object]:
    """Return a scenario with the gait of the package."""
    return document("gait") | {"controller": {"kind": "gait", "frequency_hz": 2.0}}


def problems(data: dict[str, object]) -> str:
    with pytest.raises(InputError) as error:
        parse_scenario(data)
    return str(error.value)


# What runs


def test_the_keys_are_the_arguments_of_the_class(plugin):
    path = plugin(CONTROLLER)
    allow_plugin(path)
    scenario = parse_scenario(document(f"{path.stem}:Damped", gain=0.4, limit=None))
    controller = scenario.build_controller()
    assert (controller.frequency, controller.gain, controller.limit) == (2.0, 0.4, None)
    # Defaults are written out, except those that a file cannot contain; null stays
    # null.
    written = {
        "frequency": 2.0,
        "gain": 0.4,
        "side": "left",
        "limit": None,
        "layouts": 3,
    }
    assert scenario.document["controller"] == {"kind": f"{path.stem}:Damped"} | written
    again = parse_scenario(scenario.document, set={"controller.gain": 0.5})
    assert again.build_controller().limit is None
    assert again.build_controller().gain == 0.5


def test_the_arguments_are_checked_like_other_keys(plugin, tmp_path):
    path = plugin(CONTROLLER)
    allow_plugin(path)
    (tmp_path / "s.yaml").write_text(
        f"robot: gen2\nduration_s: 1\ncontroller:\n  kind: {path.stem}:Damped\n "
        " frequenzy: 2\n  gain: much\n  side: lefft\n  weights: [1]\n"
    )
    with pytest.raises(InputError) as error:
        load_scenario(tmp_path / "s.yaml")
    lines = [line.rpartition("s.yaml:")[2] for line in str(error.value).splitlines()]
    assert lines == [
        "4:3: controller.frequency: missing; it must be a number",
        "5:3: controller.frequenzy: unknown key; did you mean frequency?",
        "6:9: controller.gain: must be a number, not text 'much'",
        (
            "7:9: controller.side: must be one of left, right, not text 'lefft'; did"
            " you mean left?"
        ),
        (
            "8:3: controller.weights: unknown key; allowed: kind, frequency, gain,"
            " side, limit, layouts, top"
        ),
    ]


def test_a_section_is_used_like_those_of_the_package(plugin):
    path = plugin(CONTROLLER, SECTION)
    allow_plugin(path)
    section = {"kind": f"{path.stem}:DampedSection", "frequency_hz": 1.5}
    data = gait() | {"controller": section}
    assert parse_scenario(data).build_controller().frequency == 1.5
    section["gain"] = 2.0
    assert "controller.gain: must be a number from 0 to 0.9, not 2" in problems(data)


def test_chambers_and_sensors_from_outside_run_on_both_plants(plugin):
    path = plugin(PARTS)
    allow_plugin(path)
    data = gait()
    data["pneumatics"] = {"kind": f"{path.stem}:Leaky", "loss": 30.0}
    data["sensor"] = {"kind": f"{path.stem}:Shifted", "offset_rad": 0.25}
    scenario = parse_scenario(data)
    for kind in ("analytical", "twin"):
        run = srs.rollout(scenario.build_plant(kind), scenario.build_controller(), 0.4)
        assert np.allclose(run["measured_bend_1"], run["bend_1"] + 0.25)
        assert run.metadata["sensor"]["kind"] == "shifted"
    # The Python interface takes the names as well, and so do environments.
    plant = srs.AnalyticalSnake(srs.load_robot("gen2"), pneumatics=f"{path.stem}:Leaky")
    assert type(plant.pneumatics).__name__ == "Leaky"
    task = make_task("GoTo", pneumatics=f"{path.stem}:Leaky", limit_s=1.0)
    episode = task.begin(np.random.default_rng(0))
    assert type(episode.twin.pneumatics).__name__ == "Leaky"


def test_a_scenario_with_own_parts_can_be_pickled(plugin):
    path = plugin(CONTROLLER, PARTS)
    allow_plugin(path)
    scenario = parse_scenario(document(f"{path.stem}:Damped"))
    copied = pickle.loads(pickle.dumps(scenario))
    assert copied == scenario and copied.build_controller().frequency == 2.0


def test_a_plugin_in_compare_and_its_run_without_it(plugin, srs_twin, tmp_path):
    path = plugin(CONTROLLER, METRICS)
    text = SCENARIO.replace("KIND", f"{path.stem}:Damped")
    expect = (
        f"expect: [{{metric: {path.stem}:heading_range_rad, plant: twin, above: 0}}]\n"
    )
    (tmp_path / "mine.yaml").write_text(text + expect)
    words = f"compare mine.yaml --plugin {path.name} --check"
    done = srs_twin(*words.split(), cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "heading range" in done.stdout
    assert "met    twin heading_range_rad" in done.stdout

    def heading_range(run: Path) -> float:
        metrics = json.loads((run / "metrics.json").read_text())
        return metrics["plants"]["twin"]["heading_range_rad"]

    # The expectation above is met.
    heading = np.array(load_run(tmp_path / "runs/mine").trajectories["twin"]["heading"])
    assert heading_range(tmp_path / "runs/mine") == pytest.approx(np.ptp(heading))
    resolved = tmp_path / "runs/mine/scenario.resolved.yaml"
    written = yaml.safe_load(resolved.read_text())
    assert written["controller"]["gain"] == 0.2
    assert written["expect"][0]["metric"] == f"{path.stem}:heading_range_rad"
    # The environment variable has the same effect, and the resolved file repeats the
    # run.
    os.environ[PLUGINS] = str(path)
    done = srs_twin(
        "compare", str(resolved), "--out", "again", "-q", "--check", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert heading_range(tmp_path / "again") == heading_range(tmp_path / "runs/mine")
    os.environ[PLUGINS] = ""
    # A finished run is read without the plug-in, even if its file is gone.
    path.unlink()
    sys.modules.pop(path.stem)
    run = load_run(tmp_path / "runs/mine")
    assert run.scenario.controller.kind == f"{path.stem}:Damped"
    with pytest.raises(InputError, match="was not imported"):
        run.scenario.build_controller()
    for words in (f"show {resolved}", "diff runs/mine again", "export mine --csv"):
        done = srs_twin(*words.split(), cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    assert srs_twin("compare", str(resolved), "-q", cwd=tmp_path).returncode == 2


@pytest.mark.slow
def test_a_sweep_with_two_workers_knows_the_plugin(plugin, tmp_path):
    path = plugin(CONTROLLER, METRICS)
    (tmp_path / "mine.yaml").write_text(SCENARIO.replace("KIND", f"{path.stem}:Damped"))
    (tmp_path / "sweep.yaml").write_text(
        f"scenario: {tmp_path}/mine.yaml\nplants: [analytical]\n"
        "vary: {controller.gain: [0.0, 0.2, 0.4]}\n"
        f"metrics: [path_length_m, {path.stem}:heading_range_rad]\n"
    )
    allow_plugin(path)
    sweep = load_sweep(tmp_path / "sweep.yaml")
    with open_sweep(sweep, tmp_path / "out") as opened:
        opened.run(local(2), opened.missing())
        summary = opened.finish()
    assert (summary.done, summary.failed) == (3, 0), summary.reasons
    rows = pq.read_table(tmp_path / "out/results.parquet").to_pydict()
    assert min(rows["analytical.heading_range_rad"]) > 0
    assert len(set(rows["analytical.path_length_m"])) == 3
    # Another version of the plug-in is noticed when the sweep resumes.
    path.write_text(path.read_text() + "\nCHANGED = 1\n")
    with (
        pytest.raises(InputError, match=f"{path.stem} changed"),
        open_sweep(load_sweep(tmp_path / "sweep.yaml"), tmp_path / "out"),
    ):
        pass
    (tmp_path / "sweep.yaml").write_text(
        f"scenario: {tmp_path}/mine.yaml\nvary: {{controller.gian: [0.0, 0.2]}}\n"
    )
    with pytest.raises(
        InputError, match=r"controller\.gian: unknown key; did you mean gain"
    ):
        load_sweep(tmp_path / "sweep.yaml")


def test_a_format_of_a_plugin_is_read(plugin, tmp_path, srs_twin):
    take = tagged_recording(tmp_path / "take.txt")
    assert identify(take) != "Tagged TSV"
    path = plugin(FORMAT)
    allow_plugin(path)
    table = read_markers(take)
    assert table.kind == "Tagged TSV" and table.points[100, 1, 0] == pytest.approx(0.15)
    done = srs_twin("inspect", str(take), "--plugin", str(path), "--json", cwd=tmp_path)
    assert json.loads(done.stdout)[0]["format"] == "Tagged TSV", done.stderr


# Installed distributions


@pytest.fixture
def site(tmp_path, monkeypatch):
    """Return the name of a distribution that is installed into a folder of the import path."""
    name = f"outside_{next(names)}"
    install(tmp_path / "site", name)
    monkeypatch.syspath_prepend(tmp_path / "site")
    return name


def test_an_installed_package_registers_short_names(site, tmp_path):
    for kind in ("damped", f"{site}.control:Damped"):
        assert parse_scenario(document(kind)).build_controller().gain == 0.2
    expect = [{"metric": "heading_range_rad", "plant": "twin", "above": 0}]
    scenario = parse_scenario({**document("damped"), "expect": expect})
    result = run_scenario(scenario, tmp_path / "run")
    assert [row["state"] for row in result.metrics["expectations"]] == ["met"]
    again = parse_scenario(scenario.document)
    assert again.document == scenario.document
    take = tagged_recording(tmp_path / "take.txt")
    assert read_markers(take).kind == "Tagged TSV"
    text = problems(document("dampt"))
    assert "controller.kind: must be one of gait" in text and "not text 'dampt'" in text


def test_a_file_may_not_name_modules_beside_the_installed_package(site, tmp_path):
    (tmp_path / "site" / "stranger_of_nobody.py").write_text(CONTROLLER)
    text = problems(document("stranger_of_nobody:Damped"))
    assert "module stranger_of_nobody is not imported" in text
    assert "stranger_of_nobody" not in sys.modules
    assert site in owners() and "numpy" not in owners()


def test_entry_points_in_the_current_folder_do_not_count(tmp_path, monkeypatch):
    install(tmp_path, "outside_here")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")
    assert "outside_here.control is not imported, because a scenario" in problems(
        document("outside_here.control:Damped")
    )
    assert "outside_here" not in sys.modules
    # A user who starts Python here may still allow it.
    allow_plugin("outside_here")
    assert parse_scenario(document("outside_here.control:Damped")).build_controller()


def test_damaged_entry_points_are_named(tmp_path, monkeypatch):
    info = tmp_path / "site" / "damaged-1.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Name: damaged\nVersion: 1\n")
    (info / "entry_points.txt").write_text(
        "[srs_twin.controllers]\nodd = not a name!\n"
    )
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert "'not a name!' is not the name of a class; write module:Name" in problems(
        document("odd")
    )


def test_the_first_of_two_packages_has_a_short_name(tmp_path, monkeypatch):
    for name in ("outside_second", "outside_first"):
        install(tmp_path / name, name)
        monkeypatch.syspath_prepend(tmp_path / name)
    scenario = parse_scenario(document("damped"))
    assert type(scenario.build_controller()).__module__ == "outside_first.control"


@pytest.mark.slow
def test_known_names_read_no_entry_points(tmp_path):
    code = """
from srs_twin import extensions
def refuse(path): raise AssertionError("entry points are read")
extensions._owners = refuse
from srs_twin.scenario.loading import load_scenario
from srs_twin.comparison.metrics import meanings
from srs_twin.cli.app import command
load_scenario("gen2_straight"); load_scenario("follow_fig57"); meanings(); command()
"""
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)


# Keys


def run_key(data: dict[str, object]) -> str:
    return run_provenance(data, ["twin"], "srs_twin.rollout").key


def test_keys_cover_the_sources_of_a_plugin(plugin):
    path = plugin(CONTROLLER)
    data = {"robot": "gen2", "controller": {"kind": f"{path.stem}:Damped"}}
    built_in = {"robot": "gen2", "controller": {"kind": "gait"}}
    without = run_key(built_in)
    allow_plugin(path)
    before = run_key(data)
    assert run_key(data) == before
    path.write_text(path.read_text() + "\nCHANGED = 1\n")
    assert run_key(data) != before
    os.environ[PLUGINS] = ""
    assert run_key(built_in) == without


def test_keys_cover_all_files_and_the_version_of_a_distribution(site, tmp_path):
    built_in = {"controller": {"kind": "gait"}}
    data = {"controller": {"kind": "damped"}}
    before = run_key(built_in)
    keys = {run_key(data), run_key({"controller": {"kind": f"{site}.control:Damped"}})}
    package = tmp_path / "site" / site
    (package / "helper.py").write_text("A = 1\n")
    keys.add(run_key(data))
    (package / "metrics.py").write_text("B = 1\n")
    keys.add(run_key(data))
    metadata = tmp_path / "site" / f"{site}-1.0.dist-info" / "METADATA"
    metadata.write_text(f"Name: {site}\nVersion: 1.1\n")
    keys.add(run_key(data))
    assert len(keys) == 5
    assert run_key(built_in) == before


# What is refused


@pytest.mark.parametrize("module", ["antigravity", "turtle.sub"])
@pytest.mark.parametrize("key", ["controller", "pneumatics", "sensor"])
def test_modules_that_nobody_allowed_are_not_imported(module, key):
    text = problems(gait() | {key: {"kind": f"{module}:Turtle"}})
    assert f"{key}.kind: module {module} is not imported" in text
    for words in ("a scenario file must not run code", "--plugin FILE.py", PLUGINS):
        assert words in text
    assert module.partition(".")[0] not in sys.modules


def test_popen_is_not_imported_by_the_command_line(tmp_path):
    (tmp_path / "s.yaml").write_text(SCENARIO.replace("KIND", "antigravity:Popen"))
    (tmp_path / "antigravity.py").write_text("open('ran', 'w')")
    code = (
        "import sys; from srs_twin.cli import main; sys.argv[0] = 'srs-twin';"
        " main(['run', 's.yaml'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith(
        "s.yaml:3:20: controller.kind: module antigravity is not imported"
    )
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "kind",
    ["{}:a.b", "{}:_Damped", ".{}:Damped", "{}:", ":Damped", "{}:Damped()", "{}/x:D"],
)
def test_other_names_are_refused_before_the_import(kind, plugin):
    path = plugin(CONTROLLER)
    allow_plugin(path)
    text = problems(document(kind.format(path.stem)))
    assert "is not the name of a class; write module:Name" in text
    assert path.stem not in sys.modules


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("Popen", "from subprocess import Popen"),
        ("absent", ""),
        ("Controller", "from srs_twin import Controller"),
        (
            "Half",
            (
                "import srs_twin\nclass Half(srs_twin.Controller):\n    def step(self,"
                " state): pass"
            ),
        ),
        ("Shifted", PARTS),
        ("Fake", "class Fake:\n    def __new__(cls, *a, **k): raise SystemExit(99)"),
    ],
)
def test_a_class_needs_the_right_base_before_it_is_called(name, source, plugin):
    path = plugin(source)
    allow_plugin(path)
    part = f"{path.stem}:{name}"
    assert (
        f"{part} is not allowed; it must be a class that derives from Controller or"
        " ControllerSection" in problems(document(part))
    )


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (
            "import no_such_name",
            "ModuleNotFoundError: No module named 'no_such_name' (FILE.py:1)",
        ),
        ("def f(:", "SyntaxError: invalid syntax (FILE.py, line 1)"),
        ("raise SystemExit(0)", "SystemExit: 0"),
        ("\n1 / 0", "ZeroDivisionError: division by zero (FILE.py:2)"),
    ],
)
def test_a_plugin_that_cannot_be_imported_is_named(source, message, plugin):
    path = plugin(source)
    allow_plugin(path)
    text = problems(document(f"{path.stem}:Damped"))
    message = message.replace("FILE", path.stem)
    said = f"controller.kind: module {path.stem} cannot be imported: {message}"
    assert said in text and "frozen" not in text


def test_arguments_that_no_file_can_give_are_named(plugin):
    path = plugin(
        "import numpy as np, srs_twin as srs\nclass A(srs.Controller):\n"
        "    def __init__(self, weights: np.ndarray): pass\n"
        "    reset = step = lambda self, *a, **k: None\n"
        "class B(A):\n    def __init__(self, gain: 'Nothing'): pass\n"
    )
    allow_plugin(path)
    assert (
        f"{path.stem}:A: the argument `weights` has a type that a scenario file cannot"
        in problems(document(f"{path.stem}:A"))
    )
    assert (
        "the types of the constructor's arguments cannot be read (name 'Nothing'"
        in problems(document(f"{path.stem}:B"))
    )


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("absent.py", "absent.py: this file does not exist"),
        (
            "no_module_of_this_name",
            "this module does not exist; give a file whose name ends in .py",
        ),
        (
            "my-file.py",
            "cannot be imported because of its name; use only letters, digits and _",
        ),
        ("numpy.py", "another module is already named numpy"),
        ("sys.py", "another module is already named sys (built in)"),
    ],
)
def test_plugins_that_cannot_be_allowed(source, message, tmp_path, srs_twin):
    for name in ("my-file.py", "numpy.py", "sys.py"):
        (tmp_path / name).write_text("open('ran', 'w')")
    done = srs_twin("compare", "gen2_straight", "--plugin", source, cwd=tmp_path)
    assert done.returncode == 2 and message in done.stderr, done.stderr
    assert not (tmp_path / "ran").exists()


def test_two_plugins_of_one_name_are_refused(plugin, tmp_path):
    path = plugin(CONTROLLER)
    allow_plugin(path)
    allow_plugin(path)  # once more is fine
    (tmp_path / "other").mkdir()
    other = tmp_path / "other" / path.name
    other.write_text("")
    with pytest.raises(InputError, match="is already named"):
        allow_plugin(other)
    assert list(plugins()) == [path.stem]


def test_a_wrong_call_of_ours_is_an_error_of_the_plugin(plugin):
    path = plugin(CONTROLLER.replace("self._gait.step(state)", "self._gait.step(None)"))
    allow_plugin(path)
    scenario = parse_scenario(document(f"{path.stem}:Damped"))
    plant = scenario.build_plant("analytical")
    with pytest.raises(AttributeError) as error:
        srs.rollout(plant, scenario.build_controller(), 0.1)
    failed = TaskFailedError(error.value)
    assert failed.exit_code == 2
    assert str(failed).startswith("error in a plug-in: AttributeError")
    assert f"({path.name}:" in str(failed) and "not part of srs-twin" in str(failed)


def test_an_error_of_a_plugin_ends_a_command_with_exit_code_2(plugin, srs_twin):
    path = plugin(CONTROLLER.replace("self.gain = gain", "1 / 0"))
    (path.parent / "s.yaml").write_text(SCENARIO.replace("KIND", f"{path.stem}:Damped"))
    done = srs_twin("run", "s.yaml", "--plugin", path.name, cwd=path.parent)
    assert done.returncode == 2 and "error in a plug-in: Zero" in done.stderr


VALUE = 'float(np.ptp(trajectory["heading"]))'


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (VALUE, "'far'"),
        (VALUE, "np.zeros(3)"),
        ('{"heading_range_rad": float', '{"com_speed_m_s": float'),
    ],
)
def test_invalid_values_of_metrics_are_named(before, after, plugin):
    path = plugin(METRICS.replace(before, after))
    allow_plugin(path)
    with pytest.raises(InputError, match=f"metric '{path.stem}:.*' .* is not allowed"):
        run_scenario(parse_scenario(gait()), plants=["analytical"])


def test_metrics_that_are_no_mapping_are_refused(plugin):
    path = plugin(METRICS.replace("return {", "return None; {"))
    allow_plugin(path)
    with pytest.raises(InputError, match=f"`measure` of {path.stem} returned None"):
        run_scenario(parse_scenario(gait()), plants=["analytical"])


def test_plugins_may_import_metrics_of_the_package(plugin):
    allow_plugin(plugin(METRICS, "from srs_twin.planning.metrics import METRICS"))
    PreparedRun.build(parse_scenario(gait()), Path(), None)


@pytest.mark.parametrize("value", ["float('nan')", "np.float32('inf')"])
def test_metrics_that_are_not_finite_are_undefined(value, plugin):
    allow_plugin(plugin(METRICS.replace(VALUE, value)))
    run = run_scenario(parse_scenario(gait()), plants=["analytical"])
    assert run.metrics["plants"]["analytical"]["heading_range_rad"] is None


def test_taken_names_of_metrics_are_refused_before_the_run(plugin, tmp_path):
    path = plugin(METRICS.replace("heading_range_rad", "com_speed_m_s"))
    allow_plugin(path)
    taken = f"metric '{path.stem}:com_speed_m_s' is not allowed, because srs-twin"
    with pytest.raises(InputError, match=taken):
        PreparedRun.build(parse_scenario(gait()), Path(), None)
    sweep = tmp_path / "sweep.yaml"
    sweep.write_text("scenario: gen2_straight\nvary: {seed: [0, 1]}\n")
    with pytest.raises(InputError, match=taken):
        load_sweep(sweep)


def test_two_plugins_with_one_metric_are_refused(plugin):
    first = plugin(METRICS)
    second = plugin(METRICS)
    importing = plugin(f"from {first.stem} import *\n")
    allow_plugin(first)
    allow_plugin(importing)
    PreparedRun.build(parse_scenario(gait()), Path(), None)
    allow_plugin(second)
    taken = (
        f"'{second.stem}:heading_range_rad' is not allowed, because {first.stem} has"
    )
    with pytest.raises(InputError, match=taken):
        PreparedRun.build(parse_scenario(gait()), Path(), None)


def test_metrics_of_unknown_modules_are_refused():
    expect = [{"metric": "antigravity:x", "plant": "twin", "above": 0}]
    text = problems(gait() | {"expect": expect})
    assert "expect[0].metric: module antigravity is not imported" in text
    assert "antigravity" not in sys.modules


def test_parts_of_a_plant_are_named_where_they_stand():
    plants = {"twin": {"pneumatics": {"kind": "orifice"}}}
    assert (
        "plants.twin.pneumatics: unknown key; did you mean pneumatics (outside of"
        " `plants`)?" in problems(gait() | {"plants": plants})
    )


def test_editors_accept_parts_from_outside():
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(scenario_json_schema())
    data = document("my_module.sub:MyController", gain=0.3)
    data |= {"pneumatics": {"kind": "a:B", "x": 1}, "sensor": {"kind": "a:B", "y": [1]}}
    data["expect"] = [{"metric": "a:swing_rad", "plant": "twin", "below": 1.0}]
    assert not list(validator.iter_errors(data))
    assert list(validator.iter_errors(document("nothing")))
    assert list(validator.iter_errors({**data, "pneumatics": {"kind": "nothing"}}))
