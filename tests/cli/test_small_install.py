"""Commands in an environment without Rerun and dm_control, as docs/ci.md installs it."""

import json
import os
import sys

import pytest

from srs_twin.cli.doctor.checks import RequiredPackage, packages_check
from srs_twin.errors import InputError
from srs_twin.viewing.rerun.viewer import has_rerun, require_rerun

HIDDEN = ("rerun", "rerun_bindings", "dm_control", "dm_env", "labmaze")
HOOK = f"""\
import sys
from importlib.abc import MetaPathFinder


class Hidden(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {HIDDEN}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)


for name in {HIDDEN}:
    sys.modules[name] = None
sys.meta_path.insert(0, Hidden())
"""
"""Contents of a module that Python imports at its start and that hides packages."""


@pytest.fixture(scope="module")
def without_rerun(tmp_path_factory, srs_twin_process):
    """Return a function that runs a command in a process in which the packages are missing."""
    hook = tmp_path_factory.mktemp("hook")
    (hook / "sitecustomize.py").write_text(HOOK)
    path = os.pathsep.join([str(hook), *filter(None, sys.path)])
    return lambda *words, cwd: srs_twin_process(*words, cwd=cwd, PYTHONPATH=path)


@pytest.mark.slow
def test_compare_works_without_rerun_and_says_so(without_rerun, tmp_path):
    done = without_rerun(
        "compare", "gen2_straight", "--duration", "2", "--out", "out", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert (
        "files in out; no recording was written, because rerun-sdk is not installed\n"
        in done.stderr
    )
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {
        "analytical.parquet",
        "metrics.json",
        "report.html",
        "scenario.resolved.yaml",
        "twin.parquet",
    }
    metrics = json.loads((tmp_path / "out/metrics.json").read_text())
    assert metrics["plants"]["twin"]["com_speed_m_s"] > 0.1


def test_viewer_commands_name_the_missing_package(monkeypatch):
    assert has_rerun()
    require_rerun()
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert not has_rerun()
    with pytest.raises(InputError, match=r"rerun-sdk is not installed; .*rerun-sdk>="):
        require_rerun()


def test_doctor_accepts_an_installation_without_rerun():
    numpy = RequiredPackage("numpy", "numpy>=1", "2", True)
    rerun = RequiredPackage("rerun-sdk", "rerun-sdk>=1", None, False)
    old = RequiredPackage("rerun-sdk", "rerun-sdk>=1", "0.9", False)
    assert packages_check([numpy, rerun], checkout=True).status == "ok"
    assert packages_check([numpy, old], checkout=True).status == "broken"
