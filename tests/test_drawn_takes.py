"""Random recordings: errors of bends and clocks, as benchmarks/takes.py and clocks.py measure them."""

from __future__ import annotations

import json

import pytest
from benchmark_runs import run_benchmark

pytestmark = pytest.mark.nightly

IDENTIFIABLE = ("start", "end", "change")
"""Cases whose clock offset the data determine."""


@pytest.mark.parametrize(("noise_mm", "most_refused"), [(0.2, 0.02), (0.4, 0.1)])
@pytest.mark.parametrize("plant", ["compliant", "twin"])
def test_bend_errors_have_the_stated_coverage(noise_mm, most_refused, plant, tmp_path):
    out = tmp_path / "takes.json"
    words = (
        "--draws",
        "30",
        "--seed",
        "300",
        "--noise-mm",
        f"{noise_mm}",
        "--plant",
        plant,
    )
    done = run_benchmark("takes.py", *words, "--json", str(out))
    assert done.returncode == 0, done.stderr
    counts = json.loads(out.read_text("utf-8"))[f"{noise_mm:g}"]
    assert counts["draws"] == 30
    assert counts["refused"] <= most_refused * 30 + 1
    assert counts["refused_after_remedy"] == []
    assert 0.93 < counts["coverage_95"] < 0.97


@pytest.mark.parametrize("spread", [0.0, 0.1])
def test_clock_offset_is_never_wrong_by_a_gait_period(spread, tmp_path):
    out = tmp_path / "clocks.json"
    words = ("--draws", "30", "--seed", "700", "--spread", str(spread))
    done = run_benchmark("clocks.py", *words, "--json", str(out))
    assert done.returncode == 0, done.stderr
    draws = json.loads(out.read_text("utf-8"))
    identifiable = [draw for draw in draws if draw["case"] in IDENTIFIABLE]
    errors = [
        abs(draw["offset_error_s"]) for draw in identifiable if not draw["refused"]
    ]
    assert len(errors) > 0.8 * len(identifiable)
    assert max(errors) < (0.005 if spread == 0 else 0.02)
    assert all(
        abs(draw["offset_error_s"]) < 0.02 for draw in draws if not draw["refused"]
    )
