"""The quickstart notebook runs in an empty folder and gives the output that its text describes."""

from __future__ import annotations

import re

import nbformat
import pytest
from conftest import ROOT
from nbclient import NotebookClient

NOTEBOOK = ROOT / "docs/quickstart.ipynb"


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """The notebook with its outputs, and the folder in which it ran."""
    folder = tmp_path_factory.mktemp("notebook")
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("DISPLAY", "WAYLAND_DISPLAY"):
            patch.delenv(name, raising=False)
        NotebookClient(
            notebook, timeout=300, resources={"metadata": {"path": str(folder)}}
        ).execute()
    return {cell.id: cell for cell in notebook.cells}, folder


def text(cell) -> str:
    return "".join(
        out.get("text", "") or out.get("data", {}).get("text/plain", "")
        for out in cell.outputs
    )


def test_notebook_is_valid_and_has_no_outputs():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    assert all(
        not cell.outputs and cell.execution_count is None
        for cell in notebook.cells
        if "outputs" in cell
    )
    assert set(notebook.metadata) == {"kernelspec", "language_info"}


@pytest.mark.slow
def test_plots_have_content(ran):
    cells, _ = ran
    for name in ("plot", "bends", "errors", "sidewinding"):
        (picture,) = (
            out.data["image/png"] for out in cells[name].outputs if "data" in out
        )
        assert len(picture) > 10_000


@pytest.mark.slow
def test_notebook_shows_the_effect_of_stiffness(ran):
    cells, _ = ran
    soft, stiff = (
        float(fraction)
        for fraction in re.findall(r"([+-][\d.]+)% in speed", text(cells["change"]))
    )
    assert soft < -5 and abs(stiff) < abs(soft) / 2
    assert "'com_speed_rel': -0." in text(cells["compare"])


@pytest.mark.slow
def test_notebook_reports_its_folder_and_the_missing_display(ran):
    cells, folder = ran
    assert (
        "recording.rrd" in text(cells["keep"])
        and (folder / "runs/gen2_straight/metrics.json").is_file()
    )
    assert "no display was found for the viewer" in text(cells["open"])


def test_links_have_targets():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    links = [
        link
        for cell in notebook.cells
        for link in re.findall(r"\]\(([^)]+)\)", cell.source)
    ]
    assert links and all((NOTEBOOK.parent / link).is_file() for link in links)
