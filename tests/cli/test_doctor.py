"""`srs-twin doctor`: failing probes have remedies, slow ones are undecided, and child processes end."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
from conftest import ROOT, on_interrupt

from srs_twin import load_robot
from srs_twin.cli import main
from srs_twin.cli.doctor import checks, examination, probes
from srs_twin.cli.doctor.checks import (
    Check,
    ProbeResult,
    cpu_quota,
    failed_checks,
    free_memory,
    result_of_exit,
)
from srs_twin.cli.doctor.examination import REMEDIES, VIEWERS, check_from, run_probes
from srs_twin.io.files import shipped_names

CPU_S = 5.0
"""Twice what a quiet machine needs: processors that share a core count more time for the same work."""


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


FAILURES = [
    (
        checks.python_check("3.10.4", ">=3.11,<3.13"),
        "broken",
        "3.10.4",
        "uv venv --python 3.12",
    ),
    (checks.python_check("3.13.0", ">=3.11,<3.13"), "broken", "3.13.0", ">=3.11,<3.13"),
    (
        checks.packages_check(
            [asked("numpy"), asked("mujoco", None, False)], checkout=True
        ),
        "missing",
        "mujoco is missing",
        "uv sync",
    ),
    (
        checks.packages_check([asked("mujoco", "4.0", False)], checkout=False),
        "broken",
        "mujoco is 4.0, but mujoco>=1",
        "pip install 'mujoco>=1'",
    ),
    (
        checks.processors_check(8, 1.5),
        "missing",
        "limits the time to that of 1.5",
        "--jobs 2",
    ),
    (checks.memory_check(300 << 20), "missing", "300 MB", "--jobs 1"),
    (checks.disk_check(Path("runs"), free=5 << 20), "missing", "5 MB", "--out"),
]


@pytest.mark.parametrize(("check", "status", "finding", "remedy"), FAILURES)
def test_each_failure_has_its_remedy(check, status, finding, remedy):
    assert (check.status, finding in check.detail, remedy in check.remedy) == (
        status,
        True,
        True,
    ), check


@pytest.mark.parametrize(
    "check",
    [
        checks.python_check("3.11.0", ">=3.11,<3.13"),
        checks.packages_check(
            [asked("numpy"), asked("ray", None, False, "ray")], checkout=True
        ),
        checks.processors_check(4, 4.0),
        checks.processors_check(4, None),
        checks.memory_check(None),
        checks.memory_check(8 << 30),
        checks.disk_check(Path("runs"), free=100 << 30),
    ],
    ids=lambda check: check.name,
)
def test_passed_check_has_no_remedy(check):
    assert (check.status, check.remedy) == ("ok", "")


def test_check_keeps_probe_result_and_adds_default_remedy():
    assert check_from("kernels", ProbeResult("ok", "fine")) == Check(
        "simulation", "kernels", "ok", "fine", "", True
    )
    assert check_from("kernels", ProbeResult("broken", "torn")).remedy.startswith(
        "reinstall numba and llvmlite"
    )
    assert (
        check_from("kernels", ProbeResult("broken", "torn", "glue it")).remedy
        == "glue it"
    )


def test_slow_probe_is_undecided():
    for code in (-signal.SIGALRM, -signal.SIGKILL):
        check = check_from("kernels", result_of_exit(code))
        assert (check.status, check.necessary, "slow" in check.detail) == (
            "undecided",
            True,
            True,
        )
        assert "run `srs-twin doctor` again" in check.remedy
        assert failed_checks([check]) == []
    crashed = check_from("kernels", result_of_exit(-signal.SIGILL))
    assert (crashed.status, crashed.detail) == (
        "broken",
        "was killed by SIGILL",
    ) and failed_checks([crashed])


def fault(probe):
    found = probe()
    assert isinstance(found, ProbeResult)
    return found.status, found.detail, found.remedy


def test_missing_or_damaged_shipped_data_is_reported(monkeypatch, tmp_path):
    assert f"{len(shipped_names('scenario'))} scenarios" in probes.data()
    monkeypatch.setattr("srs_twin.io.files.data_root", lambda: tmp_path)
    assert fault(probes.data)[:2] == (
        "missing",
        f"0 robots, 0 scenarios, 0 models in {tmp_path}",
    )
    assert fault(probes.models)[0] == "missing"
    for folder in ("calibration/robots", "scenarios"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "gen9.yaml").write_text("name: [torn")
    status, words, _ = fault(probes.data)
    assert (
        status == "broken"
        and "model gen9: " in words
        and "robot gen9: " in words
        and "not YAML" in words
    )
    (tmp_path / "models/gen9").mkdir(parents=True)
    (tmp_path / "models/gen9/scene.xml").write_text("<mujoco><worldbody>")
    status, words, remedy = fault(probes.models)
    assert (
        status == "broken"
        and "gen9: does not compile" in words
        and "srs-twin models check" in remedy
    )


def test_wrong_machine_code_is_broken(monkeypatch):
    from srs_twin.pneumatics import flow

    class Wrong:
        def __call__(self, *arguments):
            return 1.0, 2.0, 3.0

        py_func = staticmethod(flow.flow.py_func)

    assert "machine code" in probes.kernels()
    monkeypatch.setattr(flow, "flow", Wrong())
    assert fault(probes.kernels)[:2] == (
        "broken",
        "numba's machine code and Python give different results",
    )


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
        "works, but is compiled again at every start; export NUMBA_CACHE_DIR="
        in done.stdout
    )


@pytest.mark.parametrize(
    ("name", "packages"), [("egl", "libegl1"), ("osmesa", "libosmesa6")]
)
def test_missing_opengl_library_names_its_packages(monkeypatch, name, packages):
    monkeypatch.setattr(probes.ctypes.util, "find_library", lambda library: None)
    status, words, remedy = fault(probes.PROBES[name])
    assert (status, words) == ("missing", "its library is not installed")
    assert remedy.startswith(f"apt-get install {packages}")


def test_glfw_failure_reports_its_warning(monkeypatch):
    def draw_box(name):
        probes.warnings.warn("(65550) b'X11: Failed to open display :7'", stacklevel=1)
        raise RuntimeError("no context")

    monkeypatch.setattr("srs_twin.viewing.mujoco.opengl.draw_box", draw_box)
    assert fault(probes.PROBES["glfw"])[:2] == (
        "broken",
        "X11: Failed to open display :7",
    )


def test_failing_viewers_are_reported(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    script = (
        "import sys; sys.exit(\"thread panicked at 'Failed to get render context'\")"
    )
    monkeypatch.setattr(
        probes, "_rerun_command", lambda: [sys.executable, "-c", script]
    )
    assert fault(probes.headless_viewer)[:2] == (
        "missing",
        "cannot draw (Failed to get render context)",
    )
    assert fault(probes.web_viewer)[:2] == (
        "broken",
        "its page was not served on 127.0.0.1",
    )
    assert "mesa-vulkan-drivers" in REMEDIES[VIEWERS]["without a screen"]
    assert "report.html" in REMEDIES[VIEWERS]["in a browser"]


def test_results_that_follow_from_the_environment(monkeypatch):
    assert examination.known_results({"DISPLAY": ":0"}, "linux").keys() == {"rerun"}
    blind = examination.known_results({"DISPLAY": "", "MUJOCO_GL": "disabled"}, "linux")
    assert {blind[name].status for name in ("glfw", "in a window")} == {"missing"}
    assert "DISPLAY" in blind["glfw"].detail
    chosen = examination.known_results({"DISPLAY": ":0", "MUJOCO_GL": "egl"}, "linux")
    assert (chosen["osmesa"].status, chosen["osmesa"].remedy) == (
        "undecided",
        "unset MUJOCO_GL to test it",
    )
    assert examination.known_results({}, "darwin").keys() == {"rerun", "egl", "osmesa"}
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    gone = examination.known_results({}, "linux")
    assert {
        gone[name].status
        for name in ("rerun", "in a window", "without a screen", "in a browser")
    } == {"missing"}


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


def test_container_limits_apply(tmp_path):
    (tmp_path / "meminfo").write_text(
        "MemTotal: 9000000 kB\nMemAvailable:  4000000 kB\n"
    )
    assert free_memory(tmp_path, tmp_path / "meminfo") == 4_096_000_000
    (tmp_path / "cpu.max").write_text("150000 100000\n")
    (tmp_path / "memory.max").write_text(f"{1 << 30}\n")
    (tmp_path / "memory.current").write_text(f"{1 << 29}\n")
    assert cpu_quota(tmp_path) == 1.5
    assert free_memory(tmp_path, tmp_path / "meminfo") == 1 << 29
    (tmp_path / "cpu.max").write_text("max 100000\n")
    (tmp_path / "memory.max").write_text("max\n")
    assert cpu_quota(tmp_path) is None
    assert free_memory(tmp_path, tmp_path / "nothing") is None


def test_output_check_leaves_no_files(tmp_path):
    (tmp_path / "old").mkdir()
    assert checks.output_check(tmp_path / "old").status == "ok"
    assert checks.output_check(tmp_path / "new/er/est").status == "ok"
    assert [path.name for path in tmp_path.rglob("*")] == ["old"]
    (tmp_path / "file").write_text("")
    check = checks.output_check(tmp_path / "file")
    assert check.status == "broken" and check.necessary and "--out" in check.remedy
    assert ".srs-twin-doctor" not in check.detail


def gone(pid):
    """Wait up to 5 s for the end of a process; return whether it has ended or is a zombie."""
    for _ in range(100):
        try:
            state = Path(f"/proc/{pid}/stat").read_text("ascii").rpartition(") ")[2][0]
        except OSError:
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


def talks():
    print("noise", flush=True)
    os.write(1, b"noise\n[2]\n")
    return "well"


def fails():
    raise OSError("libgomp.so.1: cannot\nbe opened")


def sleeps(place):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    place.write_text(str(child.pid))
    time.sleep(60)
    return "too late"


def test_results_of_child_processes(monkeypatch):
    trials = {
        "talks": talks,
        "dies": lambda: signal.raise_signal(signal.SIGTERM),
        "fails": fails,
        "leaves": lambda: sys.exit(3),
    }
    monkeypatch.setattr(probes, "PROBES", trials)
    answers = run_probes(["json"], list(trials))
    assert answers["imports"] == ProbeResult("ok", "every package imports")
    assert answers["talks"] == ProbeResult("ok", "well")
    assert answers["dies"] == ProbeResult("broken", "was killed by SIGTERM")
    assert answers["fails"] == ProbeResult(
        "broken", "OSError: libgomp.so.1: cannot be opened"
    )
    assert answers["leaves"] == ProbeResult("broken", "ended with exit code 1")


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="looks processes up in /proc"
)
def test_a_slow_probe_is_undecided_and_costs_no_other(monkeypatch, tmp_path):
    place = tmp_path / "pid"
    monkeypatch.setattr(
        probes, "PROBES", {"sleeps": lambda: sleeps(place), "talks": talks}
    )
    answers = run_probes([], ["sleeps", "talks"], time_limit_s=3.0)
    assert (answers["sleeps"].status, answers["talks"].status) == ("undecided", "ok")
    assert "slow" in answers["sleeps"].detail
    assert gone(int(place.read_text()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "status", "detail"),
    [
        ("import time; time.sleep(60)", "undecided", "hardly: slow: no result in time"),
        (
            "import os, signal; os.kill(os.getpid(), signal.SIGTERM)",
            "broken",
            "hardly: was killed by SIGTERM",
        ),
        (
            "raise ImportError('libopenblas.so.0')",
            "broken",
            "hardly: ImportError: libopenblas.so.0",
        ),
    ],
)
def test_a_package_that_does_not_import(monkeypatch, tmp_path, source, status, detail):
    (tmp_path / "hardly.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(probes, "PROBES", {"talks": talks})
    answers = run_probes(["json", "hardly"], ["talks"], time_limit_s=3.0)
    assert (answers["imports"].status, answers["imports"].detail) == (status, detail)
    survived = "ImportError" in source
    assert answers["talks"].status == ("ok" if survived else "undecided")


def test_slow_machine_passes(monkeypatch, tmp_path, capsys):
    """Every probe runs out of its time: nothing is known, and nothing is called broken."""
    slow = dict.fromkeys(probes.PROBES, lambda: signal.raise_signal(signal.SIGALRM))
    monkeypatch.setattr(probes, "PROBES", slow)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as left:
        main(["doctor", "--json"])
    assert left.value.code == 0
    works, checks = by_name(capsys.readouterr().out)
    assert (
        works
        and checks["MuJoCo"]["status"] == checks["kernels"]["status"] == "undecided"
    )
    assert not any(check["status"] == "broken" for check in checks.values())


def test_no_room_for_temporary_files(srs_twin_process, tmp_path):
    broken = "import tempfile\ntempfile.tempdir = '/nowhere/at/all'\n"
    (tmp_path / "sitecustomize.py").write_text(broken)
    done = srs_twin_process("doctor", cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert (done.returncode, done.stdout) == (2, "")
    assert "set TMPDIR to a writable folder" in done.stderr


def by_name(text):
    document = json.loads(text)
    return document["works"], {check["name"]: check for check in document["checks"]}


def test_command_on_this_machine(srs_twin_process, tmp_path):
    run_probes([], ["kernels"])  # numba has compiled once
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = srs_twin_process(
        "doctor", "--json", "--out", str(tmp_path / "runs"), cwd=tmp_path
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < CPU_S
    works, checks = by_name(done.stdout)
    assert (done.returncode, works, done.stderr) == (0, True, "")
    keys = {"topic", "name", "status", "detail", "remedy", "necessary"}
    for name, check in checks.items():
        assert check.keys() == keys and check["status"] in (
            "ok",
            "missing",
            "broken",
            "undecided",
        ), name
        assert (check["status"] == "ok") == (check["remedy"] == ""), name
        assert check["status"] in ("ok", "undecided") or not check["necessary"], name
    robots, scenarios = (len(shipped_names(kind)) for kind in ("robot", "scenario"))
    models = sum(load_robot(name).skin is None for name in shipped_names("robot"))
    assert (
        f"{robots} robots, {scenarios} scenarios, {models} models"
        in checks["shipped data"]["detail"]
    )
    assert {"egl", "osmesa", "glfw", "rerun", "in a browser"} <= checks.keys()
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
    assert (
        done.stderr.startswith("runs would fail: imports, ")
        and "results" in done.stderr
    )
    assert (
        "libopenblas.so.0" in done.stdout
        and "Traceback" not in done.stdout + done.stderr
    )
    lines = done.stdout.splitlines()
    bad = [
        i for i, line in enumerate(lines) if line.startswith(("  missing", "  broken"))
    ]
    assert len(bad) >= 4 and all(lines[i + 1].strip().startswith("→ ") for i in bad)


def test_web_viewer_probe_ends_its_server_if_interrupts_are_ignored(tmp_path):
    with on_interrupt(signal.SIG_IGN):
        done = subprocess.run(
            [
                sys.executable,
                "-c",
                "from srs_twin.cli.doctor import probes; print(probes.web_viewer())",
            ],
            cwd=tmp_path,
            capture_output=True,
            text=True,
        )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "`srs-twin view RUN --web` serves it\n"


@pytest.mark.usefixtures("interruptible")
@pytest.mark.skipif(os.name == "nt", reason="interrupts by a signal")
def test_an_interrupt_ends_the_children(tmp_path):
    script = Path(sys.executable).with_name("srs-twin")
    process = subprocess.Popen(
        [str(script), "doctor"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        start_new_session=True,
    )
    while process.poll() is None and not any(tmp_path.glob("srs-twin-doctor-*")):
        time.sleep(0.02)
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=300)
    assert process.returncode == 130
    assert not any(tmp_path.glob("srs-twin-doctor-*"))
