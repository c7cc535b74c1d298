"""Public names: imported when they are used, visible to type checkers and editors, and picklable."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import srs_twin as srs

PACKAGE = Path(srs.__file__).parent
LAZY = [
    ".".join(path.parent.relative_to(PACKAGE.parent).parts)
    for path in sorted(PACKAGE.rglob("__init__.py"))
    if "\nlazy(" in path.read_text("utf-8")
]
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
    done = subprocess.run([sys.executable, script.name], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.fast
@pytest.mark.parametrize("package", LAZY)
def test_public_names_exist_where_type_checkers_look_for_them(package):
    module = import_module(package)
    for name, home in module._homes.items():
        assert getattr(module, name) is vars(import_module(home))[name]
    assert dir(module) == sorted(module.__all__) == sorted(module._homes)


@pytest.mark.fast
def test_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match=r"module 'srs_twin' has no attribute 'rolout'"):
        _ = srs.rolout


@pytest.mark.fast
@pytest.mark.parametrize("first", ["import srs_twin.rollout", "import srs_twin.experiment", ""])
def test_rollout_is_the_function_whatever_is_imported_first(first, tmp_path):
    code = f"{first}\nimport srs_twin as srs\nprint(srs.rollout.__qualname__, srs.rollout is srs.rollout)"
    assert run_script(tmp_path, code) == "rollout True\n"


@pytest.mark.fast
@pytest.mark.parametrize("package", LAZY)
def test_packages_are_pickled_by_name(package):
    module = import_module(package)
    assert pickle.loads(pickle.dumps(module)) is module
    assert copy.deepcopy(module) is module


def test_function_of_a_script_runs_in_another_process_by_cloudpickle(tmp_path):
    """Joblib, Ray and the subprocess environments of Stable-Baselines3 send functions in this way."""
    send = "import cloudpickle, pathlib\npathlib.Path('sent').write_bytes(cloudpickle.dumps(speed))"
    sent = run_script(tmp_path, f"{SPEED}\n{send}\nprint(speed(1.5))")
    receive = "import pathlib, pickle\nprint(pickle.loads(pathlib.Path('sent').read_bytes())(1.5))"
    assert run_script(tmp_path, receive) == sent


@pytest.mark.parametrize("method", ["fork", "spawn", "forkserver"])
def test_function_of_a_script_runs_in_a_process_pool(method, tmp_path):
    pool = f"""
if __name__ == "__main__":
    from multiprocessing import get_context

    with get_context("{method}").Pool(1) as pool:
        print(pool.map(speed, [1.0, 1.5]) == [speed(1.0), speed(1.5)])
"""
    assert run_script(tmp_path, SPEED + pool) == "True\n"
