"""`srs-twin doctor`: failing checks have remedies, and slow probes are undecided."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib

import pytest
from conftest import ROOT

from srs_twin.cli.doctor import checks, probes
from srs_twin.cli.doctor.checks import Check, failed_checks
from srs_twin.errors import InputError, SrsError


def asked(name, installed="1.0", fits=True, extra=""):
    return checks.RequiredPackage(name, f"{name}>=1", installed, fits, extra)


def test_check_has_remedy_unless_ok():
    with pytest.raises(ValueError, match="broken"):
        Check("topic", "name", "broken", "what")
    with pytest.raises(ValueError, match="ok"):
        Check("topic", "name", "ok", "what", "a remedy")


def test_only_necessary_checks_fail():
    fine = Check("t", "a", "ok", "", necessary=True)
    optional = Check("t", "b", "missing", "", "get it")
    needed = Check("t", "c", "broken", "", "mend it", necessary=True)
    assert failed_checks([fine, optional]) == []
    assert failed_checks([fine, optional, needed]) == [needed]


ALLOWED = ">=3.11,<3.13"
NO_MUJOCO = [asked("numpy"), asked("mujoco", None, False)]
OLD_MUJOCO = [asked("mujoco", "4.0", False)]
NO_RAY = [asked("numpy"), asked("ray", None, False, "ray")]


@pytest.mark.parametrize(
    ("check", "status", "finding", "remedy"),
    [
        (checks.python_check("3.10.4", ALLOWED), "broken", "3.10.4", "--python 3.12"),
        (checks.python_check("3.13.0", ALLOWED), "broken", "3.13.0", ALLOWED),
        (checks.python_check("3.11.0", ALLOWED), "ok", "3.11.0", ""),
        (
            checks.packages_check(NO_MUJOCO, checkout=True),
            "missing",
            "mujoco is missing",
            "uv sync",
        ),
        (
            checks.packages_check(OLD_MUJOCO, checkout=False),
            "broken",
            "mujoco is 4.0, but mujoco>=1",
            "pip install 'mujoco>=1'",
        ),
        (checks.packages_check(NO_RAY, checkout=True), "ok", "", ""),
    ],
)
def test_each_failure_has_its_remedy(check, status, finding, remedy):
    assert check.status == status
    assert finding in check.detail and remedy in check.remedy
    assert bool(check.remedy) == (status != "ok")


def failing_with(reason):
    def fail():
        raise InputError(reason)

    return fail


def test_models_are_missing_or_unstable(monkeypatch, tmp_path):
    assert "gen2" in probes.models()
    monkeypatch.setattr(probes, "data_root", lambda: tmp_path)
    with pytest.raises(SrsError, match="there are no models in"):
        probes.models()
    scene = tmp_path / "models/gen9/scene.xml"
    scene.parent.mkdir(parents=True)
    scene.write_text(
        '<mujoco><worldbody><body><joint name="j" armature="1e-6"/><geom size=".01"'
        ' mass="1e-6"/></body></worldbody><actuator><general joint="j"'
        ' biastype="affine" biasprm="1e12 0 0"/></actuator></mujoco>'
    )
    with pytest.raises(SrsError, match="gen9/scene.xml: MuJoCo issues warnings"):
        probes.models()


def test_wrong_machine_code_is_broken(monkeypatch):
    from srs_twin.pneumatics import flow

    class Wrong:
        def __call__(self, *arguments):
            return 1.0, 2.0, 3.0

        py_func = staticmethod(flow.flow.py_func)

    assert "machine code" in probes.kernels()
    monkeypatch.setattr(flow, "flow", Wrong())
    with pytest.raises(SrsError, match="machine code and Python give different"):
        probes.kernels()


@pytest.mark.slow
def test_kernels_without_cache_folder_report_a_remedy(srs_twin_process, tmp_path):
    """Numba has no cache folder if neither the package nor the home folder is writable."""
    broken = (
        "from numba.core import caching\n"
        "caching.CacheImpl._locator_classes = []\n"
        "from srs_twin.cli.doctor import probes\n"
        "print(probes.kernels())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", broken],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    assert (
        "works, but is compiled at every start; to avoid this, export"
        " NUMBA_CACHE_DIR=" in done.stdout
    )


@pytest.mark.parametrize(
    ("source", "status", "detail"),
    [
        ("import time; time.sleep(60)", "undecided", "no result within 2 s"),
        (
            "import os, signal; os.kill(os.getpid(), signal.SIGTERM)",
            "broken",
            "was killed by SIGTERM",
        ),
        (
            "raise ImportError('libopenblas.so.0: cannot be opened')",
            "broken",
            "ImportError: libopenblas.so.0: cannot be opened (mujoco.py:1)",
        ),
    ],
)
def test_probe_of_a_package_that_hangs_dies_or_fails(
    monkeypatch, tmp_path, source, status, detail
):
    (tmp_path / "mujoco.py").write_text(source)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(probes, "PROBES", {"MuJoCo": probes.PROBES["MuJoCo"]})
    monkeypatch.setattr(probes, "rerun_executable", failing_with("gone; get it"))
    time_limit_s = 2.0 if status == "undecided" else 60.0
    found, *_ = probes.probed_checks(time_limit_s=time_limit_s)
    assert (found.name, found.status, found.detail) == ("MuJoCo", status, detail)
    assert found.necessary and bool(failed_checks([found])) == (status == "broken")


def test_missing_or_failing_viewer_is_reported(monkeypatch, tmp_path):
    script = tmp_path / "rerun"
    script.write_text(
        "#!/bin/sh\necho \"thread panicked at 'Failed to get render context'\"\nexit 1"
    )
    script.chmod(0o700)
    monkeypatch.setattr(probes, "rerun_executable", lambda: script)
    check = probes.rerun_check(tmp_path, 60.0)
    assert check.status == "missing"
    assert check.detail == "the window cannot be drawn (Failed to get render context)"
    assert check.remedy == probes.NO_VULKAN
    script.write_text("#!/bin/sh\nexec sleep 60")
    assert probes.rerun_check(tmp_path, 0.5).status == "undecided"
    reason = failing_with("rerun is missing; install it")
    monkeypatch.setattr(probes, "rerun_executable", reason)
    check = probes.rerun_check(tmp_path, 60.0)
    assert (check.detail, check.remedy) == ("rerun is missing", "install it")


def test_machine_without_display_is_told_about_the_browser(monkeypatch):
    monkeypatch.setattr(probes, "PROBES", {})
    monkeypatch.setattr(probes, "rerun_executable", failing_with("gone; get it"))
    monkeypatch.setattr(probes, "lacks_display", lambda: True)
    *_, window = probes.probed_checks()
    assert (window.status, window.remedy) == ("missing", probes.NO_WINDOW)
    monkeypatch.setattr(probes, "lacks_display", lambda: False)
    assert [check.name for check in probes.probed_checks()] == ["Rerun viewer"]


def test_requirements_are_compared_with_what_is_installed():
    given = [
        "numpy>=2.0",
        "mujoco>=999",
        "no-such-thing>=1",
        "pytest>=1; extra == 'more'",
        "win-only; sys_platform == 'nowhere'",
    ]
    found = {each.name: each for each in checks.required_packages(given)}
    assert list(found) == ["numpy", "mujoco", "no-such-thing", "pytest"]
    assert [bool(each.fault) for each in found.values()] == [False, True, True, False]
    assert found["pytest"].extra == "more"
    some = checks.required_packages(
        ["numpy", "mujoco-warp>=1", "no-such-thing", "ray; extra == 'ray'"]
    )
    assert checks.modules(some) == ["numpy", "mujoco_warp"]


def test_extras_have_purpose_and_install_command():
    parts = [asked("ray", None, False, "ray"), asked("numpy")]
    (missing,) = checks.extra_checks(["ray"], parts, checkout=True)
    assert (missing.status, missing.remedy) == ("missing", "uv sync --extra ray")
    assert "several machines" in missing.detail
    (wheel,) = checks.extra_checks(["ray"], parts, checkout=False)
    assert wheel.remedy == "pip install 'ray>=1'"
    (there,) = checks.extra_checks(["ray"], [asked("ray", extra="ray")], checkout=True)
    assert there.status == "ok"


def test_every_extra_has_a_purpose():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert set(project.get("optional-dependencies", {})) <= checks.PURPOSES.keys()


def test_output_check_leaves_no_files(tmp_path):
    (tmp_path / "old").mkdir()
    assert checks.output_check(tmp_path / "old").status == "ok"
    assert checks.output_check(tmp_path / "new/er/est").status == "ok"
    assert [path.name for path in tmp_path.rglob("*")] == ["old"]
    (tmp_path / "file").write_text("")
    check = checks.output_check(tmp_path / "file")
    assert check.status == "broken" and check.necessary and "--out" in check.remedy
    assert ".srs-twin-doctor" not in check.detail


def test_no_room_for_temporary_files(srs_twin_process, tmp_path):
    broken = "import tempfile\ntempfile.tempdir = '/nowhere/at/all'\n"
    (tmp_path / "sitecustomize.py").write_text(broken)
    done = srs_twin_process("doctor", cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert (done.returncode, done.stdout) == (2, "")
    assert "set the environment variable TMPDIR to a writable folder" in done.stderr


def by_name(text):
    document = json.loads(text)
    return document["works"], {check["name"]: check for check in document["checks"]}


@pytest.mark.slow
def test_command_on_this_machine(srs_twin_process, tmp_path):
    done = srs_twin_process(
        "doctor", "--json", "--out", str(tmp_path / "runs"), cwd=tmp_path
    )
    works, checks = by_name(done.stdout)
    assert (done.returncode, works, done.stderr) == (0, True, "")
    keys = {"topic", "name", "status", "detail", "remedy", "necessary"}
    for name, check in checks.items():
        assert check.keys() == keys
        assert (check["status"] == "ok") == (check["remedy"] == ""), name
        assert check["status"] in ("ok", "undecided") or not check["necessary"], name
    assert {*probes.PROBES, "Rerun viewer", "results"} <= checks.keys()
    assert not any(tmp_path.iterdir())


def test_command_on_a_broken_machine(srs_twin_process, tmp_path):
    """Packages that break at import, and no place for results: all of it is said, and nothing crashes."""
    shadow = tmp_path / "shadow"
    shadow.mkdir()
    (shadow / "numpy.py").write_text(
        "raise ImportError('libopenblas.so.0: cannot open shared object file')"
    )
    (tmp_path / "runs").write_text("a file")
    done = srs_twin_process("doctor", cwd=tmp_path, PYTHONPATH=str(shadow), DISPLAY="")
    assert done.returncode == 2
    assert done.stderr.startswith("runs would fail due to imports, ")
    assert "results" in done.stderr
    assert "libopenblas.so.0" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr
    # The remedy is on the next line.
    bad = re.findall(r"^  (?:missing|broken).*\n +(→?)", done.stdout, re.MULTILINE)
    assert len(bad) >= 4 and set(bad) == {"→"}
