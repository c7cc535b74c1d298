"""Keys of rows change with everything that affects a result, and with nothing else."""

from __future__ import annotations

import gc
import sys
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from conftest import ROOT
from small import execute, write

import srs_twin
from srs_twin.errors import InputError
from srs_twin.scenario.loading import load_scenario
from srs_twin.scenario.provenance import (
    file_digests,
    run_provenance,
    source_digests,
)
from srs_twin.studies.sweep.execution import open_sweep
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.points import RUNNER, Experiment, Point
from srs_twin.studies.sweep.task import DONE, run_point

PLANS = """\
scenario: plan_fig54_5
plants: []
vary: {planner.footprint: [one.yaml, other.yaml], seed: [0, 1]}
"""
MY_SNAKE = ROOT / "calibration/examples/my_snake"
REPLAY = {
    "robot": "gen2",
    "duration_s": 1.0,
    "controller": {"kind": "replay"},
    "recording": {"motion": str(MY_SNAKE / "walk_check.csv"), "longest_gap_s": 0.3},
}
READ_BY_A_RUN = {
    "plan_fig54_5": {},
    "follow_fig57": {"duration_s": 0.5},
    "ilc_straight": {"duration_s": 0.5},
    "module_step_direct": {"duration_s": 0.2},
    "gen2_turn": {"duration_s": 0.5},
    "replay": REPLAY,
}


def rows(sweep, folder, *, changed=False):
    """Return the number of points that ran, and the results by key."""
    ran, _ = execute(sweep, folder, changed=changed)
    return ran, {
        row["key"]: row for row in pq.read_table(folder / "results.parquet").to_pylist()
    }


def test_an_edited_footprint_repeats_only_its_rows(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = (ROOT / "calibration/footprints/gen2_section52.yaml").read_text()
    for name in ("one.yaml", "other.yaml"):
        (tmp_path / name).write_text(shipped)
    sweep = write(tmp_path, PLANS)
    ran, before = rows(load_sweep(sweep), tmp_path / "out")
    assert ran == 4
    (tmp_path / "one.yaml").write_text(
        shipped.replace("5.23599", "3.5")
    )  # it turns less tightly
    refusal = r"one\.yaml changed; points changed\)\. Use --changed to keep the rows"
    with (
        pytest.raises(InputError, match=refusal),
        open_sweep(load_sweep(sweep), tmp_path / "out"),
    ):
        pass
    ran, after = rows(load_sweep(sweep), tmp_path / "out", changed=True)
    assert ran == 2
    stored = {
        key for key, row in before.items() if row["planner.footprint"] == "other.yaml"
    }
    assert before.keys() & after.keys() == stored
    _, fresh = rows(load_sweep(sweep), tmp_path / "fresh")

    def lengths(table):
        return {
            (row["planner.footprint"], row["seed"]): row["plan.plan_length_m"]
            for row in table.values()
        }

    assert lengths(after) == lengths(fresh)
    moved = {
        place
        for place, length in lengths(after).items()
        if length != lengths(before)[place]
    }
    assert moved == {("one.yaml", 0), ("one.yaml", 1)}


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("name", READ_BY_A_RUN)
def test_all_files_and_sources_of_a_run_are_in_its_key(name):
    """Opened files and sources of called functions are observed during the run."""
    document = {
        **({} if name == "replay" else load_scenario(name).document),
        **READ_BY_A_RUN[name],
    }
    plants = () if name.startswith("plan") else ("analytical", "twin")
    package = Path(srs_twin.__file__).parent
    opened = set()
    called = set()
    watching = [True]

    def note(event, arguments):
        if watching and event == "open" and "site-packages" not in str(arguments[0]):
            opened.add(str(arguments[0]))

    def profile(frame, event, argument):
        if frame.f_code.co_name != "<module>":  # a package that is only passed through
            called.add(frame.f_code.co_filename)

    gc.collect()  # finalisers of earlier tests would count as called functions
    sys.addaudithook(note)  # stays for good, deaf afterwards
    before = sys.getprofile()
    sys.setprofile(profile)
    try:
        row = run_point(Experiment(document, plants), Point("key", {}))
    finally:
        sys.setprofile(before)
        watching.clear()
    assert row.status == DONE, row.reason
    data = {
        path
        for path in opened
        if path.endswith((".yaml", ".yml", ".csv", ".json", ".xml", ".parquet"))
    }
    # A robot's file is written out in the document of a scenario that was loaded.
    robots = (
        {path for path in data if "calibration/robots" in path}
        if name == "replay"
        else set()
    )
    assert data - robots <= file_digests(document).keys()
    ours = {
        Path(path).relative_to(package)
        for path in called
        if path.startswith(f"{package}/")
    }
    modules = {".".join(("srs_twin", *path.with_suffix("").parts)) for path in ours}
    modules = {module.removesuffix(".__init__") for module in modules}
    assert (
        len(modules) > 10
        and modules - {"srs_twin"}
        <= run_provenance(document, plants, RUNNER).sources.keys()
    )


def test_a_plan_and_a_run_of_one_scenario_have_different_keys():
    document = load_scenario("follow_fig57").document
    keys = {
        run_provenance(document, plants, RUNNER).key
        for plants in ((), ("twin",), ("analytical", "twin"))
    }
    assert len(keys) == 3


def test_keys_do_not_depend_on_presentation():
    rooms = {name.split(".")[1] for name in source_digests(RUNNER) if name.count(".")}
    assert not rooms & {
        "cli",
        "viewing",
        "reproduction",
        "doctor",
        "attribution",
        "envs",
    }
