"""srs-twin doctor: every remedy comes when its probe fails, children end, the command says it all."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
from conftest import ROOT, on_interrupt

from srs_twin.doctor import children, machine, packages, simulation, viewers
from srs_twin.doctor.check import Check, failing
from srs_twin.doctor.children import Answer, Question, ask, first_error
from srs_twin.doctor.machine import Machine
from srs_twin.files import shipped_names

SCREEN = "DISPLAY=:0"
DRAWN = {"library": "libEGL.so.1", "warnings": [], "size": [120, 160], "shades": 200}
DATA = {"root": "/data", "robots": 4, "scenarios": 7, "models": 4, "bad": []}
KERNELS = {"agrees": True, "cache": "/cache"}
MODELS = {"models": ["gen2"], "bad": []}
LATE = Answer(None, complaint="no answer within 15 s")


def crash(complaint, **said):
    return Answer(1, said, complaint)


def well(**said):
    return Answer(0, said)


def asked(name, installed="1.0", fits=True, extra=""):
    return packages.Wanted(name, f"{name}>=1", installed, fits, extra)


def test_a_check_has_a_remedy_exactly_when_it_needs_one():
    with pytest.raises(ValueError, match="broken"):
        Check("topic", "name", "broken", "what")
    with pytest.raises(ValueError, match="ok"):
        Check("topic", "name", "ok", "what", "a remedy")


def test_only_what_is_necessary_decides():
    fine = Check("t", "a", "ok", "", necessary=True)
    optional = Check("t", "b", "missing", "", "get it")
    needed = Check("t", "c", "broken", "", "mend it", necessary=True)
    assert failing([fine, optional]) == []
    assert failing([fine, optional, needed]) == [needed]


FAILURES = [
    (packages.python_check("3.10.4", ">=3.11,<3.13"), "broken", "3.10.4", "uv venv --python 3.12"),
    (packages.python_check("3.13.0", ">=3.11,<3.13"), "broken", "3.13.0", ">=3.11,<3.13"),
    (packages.packages_check([asked("numpy"), asked("mujoco", None, False)], checkout=True),
     "missing", "mujoco is missing", "uv sync"),
    (packages.packages_check([asked("mujoco", "4.0", False)], checkout=False),
     "broken", "mujoco is 4.0, but mujoco>=1", "pip install 'mujoco>=1'"),
    (packages.imports_check(crash("ImportError: libgomp.so.1", importing="scipy")),
     "broken", "scipy: ImportError: libgomp.so.1", "install scipy anew"),
    (packages.imports_check(Answer(-4, {"importing": "mujoco"}, "ended by SIGILL")),
     "broken", "mujoco: ended by SIGILL", "install mujoco anew"),
    (packages.imports_check(crash("AttributeError: glGetError", importing="mujoco"), gl="osmesa"),
     "broken", "glGetError", "unset MUJOCO_GL"),
    (simulation.data_check(crash("FileNotFoundError: scenarios")), "broken", "scenarios", "srs-twin anew"),
    (simulation.data_check(well(**DATA | {"scenarios": 0})), "missing", "0 scenarios", "srs-twin anew"),
    (simulation.data_check(well(**DATA | {"bad": ["robot gen2: torn"]})), "broken", "gen2: torn", "anew"),
    (simulation.kernels_check(crash("RuntimeError: cannot cache function 'axis': no locator available")),
     "broken", "no folder", "export NUMBA_CACHE_DIR="),
    (simulation.kernels_check(well(agrees=False, cache="")), "broken", "other numbers", "anew"),
    (simulation.kernels_check(LATE), "broken", "no answer", "numba and llvmlite anew"),
    (simulation.mujoco_check(crash("ImportError: libmujoco")), "broken", "libmujoco", "MuJoCo anew"),
    (simulation.mujoco_check(well(models=["gen2"], bad=["gen2: does not compile"])),
     "broken", "does not compile", "srs-twin models check"),
    (simulation.mujoco_check(well(models=[], bad=[])), "missing", "no model", "anew"),
    (viewers.rendering_check("egl", crash("AttributeError: eglQueryString", library=None), ""),
     "missing", "not installed", "apt-get install libegl1"),
    (viewers.rendering_check("egl", crash("ImportError: no device", library="libEGL.so.1"), ""),
     "broken", "no device", "libgl1-mesa-dri"),
    (viewers.rendering_check("egl", LATE, ""), "broken", "no answer", "driver"),
    (viewers.rendering_check("egl", well(**DRAWN | {"shades": 1}), ""), "broken", "same colour", "driver"),
    (viewers.rendering_check("osmesa", crash("AttributeError", library=None), ""),
     "missing", "not installed", "apt-get install libosmesa6"),
    (viewers.rendering_check("osmesa", crash("GLError", library="libOSMesa.so.8"), ""),
     "broken", "GLError", "--reinstall libosmesa6"),
    (viewers.rendering_check("glfw", crash("FatalError", library="glfw", warnings=["(7) b'X11: no'"]), ""),
     "missing", "X11: no", "MUJOCO_GL=egl"),
    (viewers.rendering_check("glfw", crash("FatalError", library="glfw"), SCREEN),
     "broken", "FatalError", "xvfb-run"),
    (machine.processors_check(Machine(8, 1.5, None)), "missing", "time of 1.5", "--jobs 2"),
    (machine.memory_check(Machine(2, None, 300 << 20)), "missing", "300 MB", "--jobs 1"),
    (machine.disk_check(Path("runs"), free=5 << 20), "missing", "5 MB", "--out"),
]  # fmt: skip


@pytest.mark.parametrize(("check", "mark", "finding", "remedy"), FAILURES)
def test_each_failure_has_its_remedy(check, mark, finding, remedy):
    assert (check.mark, finding in check.detail, remedy in check.remedy) == (mark, True, True), check


@pytest.mark.parametrize(
    "check",
    [
        packages.python_check("3.11.0", ">=3.11,<3.13"),
        packages.packages_check([asked("numpy"), asked("ray", None, False, "ray")], checkout=True),
        packages.imports_check(well(importing="")),
        simulation.data_check(well(**DATA)),
        simulation.kernels_check(well(**KERNELS)),
        simulation.mujoco_check(well(**MODELS)),
        viewers.rendering_check("egl", well(**DRAWN), ""),
        machine.processors_check(Machine(4, 4.0, None)),
        machine.processors_check(Machine(4, None, None)),
        machine.memory_check(Machine(4, None, None)),
        machine.memory_check(Machine(4, None, 8 << 30)),
        machine.disk_check(Path("runs"), free=100 << 30),
    ],
    ids=lambda check: check.name,
)
def test_what_works_needs_no_remedy(check):
    assert (check.mark, check.remedy) == ("ok", "")


def viewer(program="/bin/rerun", screen=SCREEN, headless=None, web=None, window=None):
    checks = viewers.viewer_checks(
        Path(program) if program else None,
        screen,
        headless or well(drawn=True, words=""),
        web or well(served=True),
        window or well(**DRAWN),
    )
    return {check.name: check for check in checks}


def test_viewers():
    assert {check.mark for check in viewer().values()} == {"ok"}
    (only,) = viewer(program="").values()
    assert (only.mark, "rerun-sdk" in only.remedy) == ("missing", True)
    blind = viewer(screen="")["in a window"]
    assert blind.mark == "missing" and "DISPLAY" in blind.detail and "report.html" in blind.remedy
    deaf = viewer(window=crash("no", warnings=['(65550) b"X11: Failed to open display :7"']))["in a window"]
    assert deaf.mark == "broken" and deaf.detail.endswith("X11: Failed to open display :7")
    for answer in (well(drawn=False, words="Failed to get render context"), LATE):
        check = viewer(headless=answer)["without a screen"]
        assert check.mark == "missing" and "mesa-vulkan-drivers" in check.remedy
    for answer in (well(served=False), LATE, crash("InputError: gone")):
        check = viewer(web=answer)["in a browser"]
        assert check.mark == "broken" and "report.html" in check.remedy


def test_screen_and_backends_of_a_platform():
    assert viewers.display({"DISPLAY": ":0", "WAYLAND_DISPLAY": ""}, "linux") == "DISPLAY=:0"
    assert viewers.display({}, "linux") == ""
    assert viewers.display({}, "darwin")
    assert viewers.backends("linux") == ("egl", "osmesa", "glfw")
    assert viewers.backends("darwin") == ("glfw",)


def test_requirements_are_compared_with_what_is_installed():
    given = [
        "numpy>=2.0", "mujoco>=999", "no-such-thing>=1", "pytest>=1; extra == 'more'",
        "win-only; sys_platform == 'nowhere'",
    ]  # fmt: skip
    found = {each.name: each for each in packages.wanted(given)}
    assert list(found) == ["numpy", "mujoco", "no-such-thing", "pytest"]
    assert [bool(each.fault) for each in found.values()] == [False, True, True, False]
    assert found["pytest"].extra == "more"
    assert packages.modules(["numpy", "dm-control>=1", "no-such-thing"]) == ["dm_control", "numpy"]


def test_extras_say_what_for_and_how():
    parts = [asked("ray", None, False, "ray"), asked("numpy")]
    (missing,) = packages.extra_checks(["ray"], parts, checkout=True)
    assert (missing.mark, missing.remedy) == ("missing", "uv sync --extra ray")
    assert "several machines" in missing.detail
    (wheel,) = packages.extra_checks(["ray"], parts, checkout=False)
    assert wheel.remedy == "pip install 'ray>=1'"
    (there,) = packages.extra_checks(["ray"], [asked("ray", extra="ray")], checkout=True)
    assert there.mark == "ok"


def test_every_extra_has_a_purpose():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert set(project.get("optional-dependencies", {})) <= packages.PURPOSES.keys()


def test_limits_of_a_container_count(tmp_path):
    (tmp_path / "meminfo").write_text("MemTotal: 9000000 kB\nMemAvailable:  4000000 kB\n")
    assert Machine.here(tmp_path, tmp_path / "meminfo").memory == 4_096_000_000
    (tmp_path / "cpu.max").write_text("150000 100000\n")
    (tmp_path / "memory.max").write_text(f"{1 << 30}\n")
    (tmp_path / "memory.current").write_text(f"{1 << 29}\n")
    here = Machine.here(tmp_path, tmp_path / "meminfo")
    assert (here.share, here.memory) == (1.5, 1 << 29)
    (tmp_path / "cpu.max").write_text("max 100000\n")
    (tmp_path / "memory.max").write_text("max\n")
    here = Machine.here(tmp_path, tmp_path / "nothing")
    assert (here.share, here.memory) == (None, None)
    assert here.processors >= 1


def test_trying_to_write_leaves_nothing(tmp_path):
    (tmp_path / "old").mkdir()
    assert machine.output_check(tmp_path / "old").mark == "ok"
    assert machine.output_check(tmp_path / "new/er/est").mark == "ok"
    assert [path.name for path in tmp_path.rglob("*")] == ["old"]
    (tmp_path / "file").write_text("")
    check = machine.output_check(tmp_path / "file")
    assert check.mark == "broken" and check.necessary and "--out" in check.remedy
    assert ".srs-twin-doctor" not in check.detail


def test_first_error_is_the_cause():
    said = [
        "a warning", "Traceback (most recent call last):", '  File "x", line 1', "OSError: first",
        "", "During handling of the above exception, another exception occurred:", "",
        "Traceback (most recent call last):", "ValueError: second",
    ]  # fmt: skip
    assert first_error(said) == "OSError: first"
    assert first_error(["only", "words", ""]) == "words"
    assert first_error([]) == ""


PROBE = """
import os, subprocess, sys, time
from pathlib import Path
what, place = sys.argv[1:]
if what == "talks":
    print('noise'); print('{"a": 1}'); print('[2]'); print('{"b": 2}')
if what == "dies":
    os.abort()
if what == "fails":
    raise SystemExit(3)
if what == "sleeps":
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    Path(place).write_text(str(child.pid))
    time.sleep(60)
if what == "leaves":
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    Path(place).write_text(str(child.pid))
"""


@pytest.fixture
def trial(tmp_path, monkeypatch):
    """Children run PROBE in place of the shipped probes."""
    program = tmp_path / "probe.py"
    program.write_text(PROBE)
    start = subprocess.Popen

    def instead(command, **options):
        assert command[:3] == [sys.executable, "-m", "srs_twin.doctor.probes"]
        return start([sys.executable, str(program), *command[3:]], **options)

    monkeypatch.setattr(children.subprocess, "Popen", instead)
    return tmp_path


def gone(pid):
    """Whether a process is gone, or is what nobody has waited for yet; waits a moment for it."""
    for _ in range(100):
        try:
            state = Path(f"/proc/{pid}/stat").read_text("ascii").rpartition(") ")[2][0]
        except OSError:
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


def test_answers_of_children(trial):
    asked = {name: Question((name, "")) for name in ("talks", "dies", "fails")}
    answers = ask(asked, limit_s=20.0)
    assert answers["talks"] == Answer(0, {"a": 1, "b": 2})
    assert (answers["dies"].code, answers["dies"].complaint) == (-signal.SIGABRT, "ended by SIGABRT")
    assert (answers["fails"].code, answers["fails"].complaint) == (3, "ended with exit code 3")


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks processes up in /proc")
@pytest.mark.parametrize("what", ["sleeps", "leaves"])
def test_nothing_that_a_child_started_is_left(trial, what):
    place = trial / "pid"
    answers = ask({"x": Question((what, str(place)))}, limit_s=3.0)
    assert answers["x"].code == (None if what == "sleeps" else 0)
    assert gone(int(place.read_text()))


def test_no_room_for_temporary_files(srs_twin, tmp_path):
    broken = "import tempfile\ntempfile.tempdir = '/nowhere/at/all'\n"
    (tmp_path / "sitecustomize.py").write_text(broken)
    done = srs_twin("doctor", cwd=tmp_path, PYTHONPATH=str(tmp_path))
    assert (done.returncode, done.stdout) == (2, "")
    assert "set TMPDIR to a folder that can be written" in done.stderr


def by_name(text):
    document = json.loads(text)
    return document["works"], {check["name"]: check for check in document["checks"]}


def test_command_on_this_machine(srs_twin, tmp_path):
    done = srs_twin("doctor", "--json", "--out", str(tmp_path / "runs"), cwd=tmp_path)
    works, checks = by_name(done.stdout)
    assert (done.returncode, works, done.stderr) == (0, True, "")
    keys = {"topic", "name", "mark", "detail", "remedy", "necessary"}
    for name, check in checks.items():
        assert check.keys() == keys and check["mark"] in ("ok", "missing", "broken"), name
        assert (check["mark"] == "ok") == (check["remedy"] == ""), name
        assert check["mark"] == "ok" or not check["necessary"], name
    robots, scenarios = (len(shipped_names(kind)) for kind in ("robot", "scenario"))
    assert f"{robots} robots, {scenarios} scenarios, {robots} models" in checks["shipped data"]["detail"]
    assert {"egl", "osmesa", "glfw", "rerun", "in a browser"} <= checks.keys()
    assert not any(tmp_path.iterdir())


def test_command_on_a_broken_machine(srs_twin, tmp_path):
    """Packages that break at import, and no place for results: all of it is said, and nothing crashes."""
    shadow = tmp_path / "shadow"
    shadow.mkdir()
    (shadow / "numpy.py").write_text("raise ImportError('libopenblas.so.0: cannot open shared object file')")
    (tmp_path / "runs").write_text("a file")
    done = srs_twin("doctor", cwd=tmp_path, PYTHONPATH=str(shadow), DISPLAY="")
    assert done.returncode == 2
    assert done.stderr.startswith("not fit for runs: imports, ") and "results" in done.stderr
    assert "libopenblas.so.0" in done.stdout and "Traceback" not in done.stdout + done.stderr
    lines = done.stdout.splitlines()
    bad = [i for i, line in enumerate(lines) if line.startswith(("  missing", "  broken"))]
    assert len(bad) >= 4 and all(lines[i + 1].strip().startswith("→ ") for i in bad)


def test_the_web_viewer_that_was_tried_out_ends_where_interrupts_are_ignored(tmp_path):
    with on_interrupt(signal.SIG_IGN):
        done = subprocess.run(
            [sys.executable, "-m", "srs_twin.doctor.probes", "web_viewer"],
            cwd=tmp_path, capture_output=True, text=True,
        )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.usefixtures("interruptible")
@pytest.mark.skipif(os.name == "nt", reason="interrupts by a signal")
def test_an_interrupt_ends_the_children(tmp_path):
    script = Path(sys.executable).with_name("srs-twin")
    process = subprocess.Popen(
        [str(script), "doctor"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        env={**os.environ, "TMPDIR": str(tmp_path)}, start_new_session=True,
    )  # fmt: skip
    while process.poll() is None and not any(tmp_path.glob("srs-twin-doctor-*")):
        time.sleep(0.02)
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)
    assert process.returncode == 130
    assert not any(tmp_path.glob("srs-twin-doctor-*"))
