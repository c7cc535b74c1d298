"""Public names: imported when they are used, visible to type checkers and editors, and picklable."""

from __future__ import annotations

import copy
import pickle
import re
from importlib import import_module
from pathlib import Path

import jedi
import pytest
from processes import python

import srs_twin as srs

PACKAGE = Path(srs.__file__).parent
LAZY = [
    ".".join(path.parent.relative_to(PACKAGE.parent).parts)
    for path in sorted(PACKAGE.rglob("__init__.py"))
    if "\nlazy(" in path.read_text("utf-8")
]
USER_SCRIPT = Path(__file__).parent / "helpers" / "user_script.py"
MISTAKES = """
import srs_twin as srs
from srs_twin.planning import Fotprint  # type: ignore[attr-defined]

srs.rolout()  # type: ignore[attr-defined]
srs.load_robot(2)  # type: ignore[arg-type]
srs.compare("gen2_straight").speed  # type: ignore[attr-defined]
"""
SPEED = """
import srs_twin as srs


def speed(frequency):
    plant = srs.AnalyticalSnake(srs.load_robot("gen2"))
    run = srs.rollout(plant, srs.Gait(frequency), 0.5)
    return float(run["com_x"][-1])
"""


def run_script(folder: Path, source: str) -> str:
    script = folder / "script.py"
    script.write_text(source, "utf-8")
    return python(script.name, cwd=folder).stdout


@pytest.mark.default_cases(2)
@pytest.mark.fast
@pytest.mark.parametrize("package", LAZY)
def test_public_names_exist_where_type_checkers_look_for_them(package):
    module = import_module(package)
    for name, home in module._homes.items():
        assert getattr(module, name) is vars(import_module(home))[name]
    assert dir(module) == sorted(module.__all__) == sorted(module._homes)


@pytest.mark.fast
def test_unknown_name_is_an_attribute_error():
    with pytest.raises(
        AttributeError, match=r"module 'srs_twin' has no attribute 'rolout'"
    ):
        _ = srs.rolout


@pytest.mark.fast
def test_rollout_is_the_function_even_if_its_module_is_imported_first(tmp_path):
    code = "import srs_twin.rollout\nimport srs_twin as srs\n"
    code += "print(srs.rollout.__qualname__, srs.rollout is srs.rollout)"
    assert run_script(tmp_path, code) == "rollout True\n"


@pytest.mark.default_cases(2)
@pytest.mark.fast
@pytest.mark.parametrize("package", LAZY)
def test_packages_are_pickled_by_name(package):
    module = import_module(package)
    assert pickle.loads(pickle.dumps(module)) is module
    assert copy.deepcopy(module) is module


@pytest.mark.slow
def test_function_of_a_script_runs_in_another_process_by_cloudpickle(tmp_path):
    """Joblib, Ray and the subprocess environments of Stable-Baselines3 send functions in this way."""
    send = (
        "import cloudpickle,"
        " pathlib\npathlib.Path('sent').write_bytes(cloudpickle.dumps(speed))"
    )
    sent = run_script(tmp_path, f"{SPEED}\n{send}\nprint(speed(1.5))")
    receive = (
        "import pathlib,"
        " pickle\nprint(pickle.loads(pathlib.Path('sent').read_bytes())(1.5))"
    )
    assert run_script(tmp_path, receive) == sent


@pytest.mark.slow
def test_type_checkers_understand_a_users_script_and_a_new_controller(
    srs_twin, tmp_path, request
):
    """Unused ignores are errors: mypy must find each mistake and nothing else."""
    assert srs_twin("new", "controller", "wriggle", cwd=tmp_path).returncode == 0
    (tmp_path / "mistakes.py").write_text(MISTAKES, "utf-8")
    (tmp_path / USER_SCRIPT.name).write_bytes(USER_SCRIPT.read_bytes())
    scripts = ("mistakes.py", USER_SCRIPT.name, "wriggle.py")
    cache = request.config.cache.mkdir("mypy")
    options = ("--strict", "--cache-dir", cache)
    done = python("-m", "mypy", *options, *scripts, cwd=tmp_path)
    assert done.stdout == "Success: no issues found in 3 source files\n"


@pytest.mark.slow
def test_the_users_script_runs(tmp_path):
    run_script(tmp_path, USER_SCRIPT.read_text("utf-8"))


def test_users_script_has_all_public_names():
    assert {f"srs.{name}" for name in srs.__all__} <= set(
        re.findall(r"srs\.\w+", USER_SCRIPT.read_text("utf-8"))
    )


BUILT = """
import srs_twin as srs
spec = srs.load_robot("gen2")
twin = srs.TwinSnake(spec)
run = srs.rollout(twin, srs.Gait(1.0), 1.0)
"""


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("srs.", srs.__all__),
        ("run.", ["com", "time", "stack", "to_parquet"]),
        ("twin.", ["step", "reset", "save", "spec"]),
        ("spec.", ["geometry", "friction", "mass"]),
        ("srs.compare('gen2_straight').", ["metrics", "shape_error"]),
    ],
)
def test_editors_complete(line, names):
    script = jedi.Script(BUILT + line)
    assert set(names) <= {each.name for each in script.complete()}


def test_editors_show_arguments():
    (signature,) = jedi.Script(BUILT + "srs.rollout(").get_signatures()
    assert [each.name for each in signature.params][:4] == [
        "plant",
        "controller",
        "duration",
        "pose",
    ]
    assert signature.to_string().endswith("-> Trajectory")
