"""A distribution outside the repository: built as a wheel, installed, and used by the command line."""

from __future__ import annotations

import json
import shutil
import subprocess

import pytest
from outside import SCENARIO, tagged_recording, write_package

pytestmark = pytest.mark.slow

PROJECT = """\
[build-system]
requires = ["uv_build"]
build-backend = "uv_build"

[project]
name = "my-snake-parts"
version = "1.2"

[project.entry-points."srs_twin.controllers"]
damped = "my_snake_parts.control:Damped"

[project.entry-points."srs_twin.metrics"]
heading = "my_snake_parts.metrics:GROUP"

[project.entry-points."srs_twin.formats"]
tagged = "my_snake_parts.formats:Tagged"
"""


@pytest.mark.skipif(shutil.which("uv") is None, reason="uv builds the wheel")
def test_a_wheel_adds_a_controller_a_metric_and_a_format(srs_twin_process, tmp_path):
    write_package(tmp_path / "project" / "src", "my_snake_parts")
    (tmp_path / "project" / "pyproject.toml").write_text(PROJECT)
    wheel = "dist/my_snake_parts-1.2-py3-none-any.whl"
    for words in (
        "uv build --wheel --out-dir dist project",
        f"uv pip install --no-deps --no-index --target site {wheel}",
    ):
        subprocess.run(words.split(), cwd=tmp_path, check=True, capture_output=True)
    here = tmp_path / "work"
    here.mkdir()
    expect = "expect: [{metric: heading_range_rad, plant: twin, above: 0}]\n"
    (here / "short.yaml").write_text(SCENARIO.replace("KIND", "damped") + expect)
    (here / "full.yaml").write_text(
        SCENARIO.replace("KIND", "my_snake_parts.control:Damped")
    )
    take = tagged_recording(here / "take.txt")

    def run(*words: str, installed: bool = True, code: int = 0) -> str:
        environment = {"PYTHONPATH": str(tmp_path / "site")} if installed else {}
        done = srs_twin_process(*words, cwd=here, **environment)
        assert done.returncode == code, done.stderr
        return done.stdout or done.stderr

    assert "met    twin heading_range_rad" in run("compare", "short.yaml", "--check")
    run("run", "short.yaml", "full.yaml", "--workers", "2", "--out", "both", "-q")
    assert (here / "both/full/metrics.json").is_file()
    assert json.loads(run("inspect", str(take), "--json"))[0]["format"] == "Tagged TSV"
    # Without the package the run is still read, but not run again.
    resolved = "runs/short/scenario.resolved.yaml"
    assert "controller.gain: 0.2" in run("show", resolved, installed=False)
    run("export", "short", "--csv", installed=False)
    text = run("compare", resolved, "-q", installed=False, code=2)
    assert "controller.kind: must be one of gait" in text and "'damped'" in text
    text = run("compare", "full.yaml", "-q", installed=False, code=2)
    assert text.startswith(
        "full.yaml:3:20: controller.kind: module my_snake_parts.control is not imported"
    )
