"""docs/sweeps.md: its file loads, its examples run, and the files that it lists are written."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import nbformat
import pytest
from conftest import ROOT
from nbclient import NotebookClient
from small import SMALL, write

from srs_twin.cli import main
from srs_twin.io.files import shipped_names
from srs_twin.studies.sweep.execution import local, open_sweep
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.points import SweepFile

PAGE = (ROOT / "docs" / "sweeps.md").read_text("utf-8")
FENCES = dict(
    reversed(re.findall(r"^```(\w+)\n(.*?)^```$", PAGE, re.M | re.S))
)  # the first of each kind
EXAMPLE = FENCES["python"].replace('"fig32_simplified"', '"small.yaml"')


def test_the_printed_file_loads(tmp_path):
    sweep = load_sweep(write(tmp_path, FENCES["yaml"], "printed.yaml"))
    assert len(sweep.points) == 6
    assert (
        set(re.findall(r"^\| `(\w+)` \|", PAGE, re.M)) <= SweepFile.model_fields.keys()
    )


def test_every_shipped_sweep_is_listed():
    assert {name for name in re.findall(r"`(\w+)`", PAGE)} >= set(
        shipped_names("sweep")
    ) - {"fig39"}
    assert FENCES["sh"] == "uv run srs-twin sweep fig39\n"


def test_the_listed_files_are_written(tmp_path):
    plot = "plots: [{kind: line, x: supply.pressure_kpa, metric: com_speed_m_s}]\n"
    with open_sweep(
        load_sweep(write(tmp_path, SMALL + plot)), tmp_path / "out"
    ) as opened:
        opened.run(local(1), opened.missing())
        summary = opened.finish()
    left = {
        f"{path.name}/" if path.is_dir() else path.name
        for path in (tmp_path / "out").iterdir()
    }
    promised = {
        name
        for row in re.findall(r"^\| (`[\w./`, ]+) \|", PAGE, re.M)
        for name in re.findall(r"`([\w.]+[./]\w*)`", row)
    }
    assert left == promised
    assert all((tmp_path / "out" / name).exists() for name in summary.files)


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [("example.py",), ("-c", EXAMPLE), ("-",)], ids=["script", "-c", "stdin"]
)
def test_the_example_runs_without_a_main_guard(options, tmp_path):
    (tmp_path / "example.py").write_text(EXAMPLE)
    write(tmp_path)
    program = [sys.executable, *options]
    run = subprocess.run(
        program,
        cwd=tmp_path,
        input=EXAMPLE,
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.stderr == ""
    assert re.fullmatch(r"[0-9a-f]{64}\n", run.stdout), (
        "by this process, and by no worker"
    )


@pytest.mark.slow
def test_the_example_runs_in_a_notebook(tmp_path):
    write(tmp_path)
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(EXAMPLE)])
    NotebookClient(
        notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    (output,) = notebook.cells[0].outputs
    assert re.fullmatch(r"[0-9a-f]{64}\n", output["text"])


def test_every_key_has_a_description_in_the_schema(capsys):
    main_exit(["schema", "sweep"])
    schema = json.loads(capsys.readouterr().out)
    assert set(schema["properties"]) == set(SweepFile.model_fields)
    for block in (schema, schema["$defs"]["Plot"]):
        assert all(
            key["title"] and key["description"] for key in block["properties"].values()
        )


def main_exit(options):
    with pytest.raises(SystemExit) as end:
        main(options)
    assert not end.value.code
