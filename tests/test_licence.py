"""Licence and citation agree in the package, its metadata and CITATION.cff."""

from __future__ import annotations

import tomllib
from importlib import metadata

import pytest
import yaml
from conftest import ROOT

import srs_twin

pytestmark = pytest.mark.fast

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_installed_package_states_its_licence():
    about = metadata.metadata("srs-twin")
    assert about["License-Expression"] == PROJECT["license"] == "Apache-2.0"
    assert set(about.get_all("License-File")) == set(PROJECT["license-files"])
    for name in PROJECT["license-files"]:
        assert "Apache License" in (ROOT / name).read_text()


def test_citation_has_this_version_and_names_the_dissertation():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert citation["version"] == srs_twin.__version__
    assert citation["license"] == PROJECT["license"]
    thesis = citation["references"][0]
    assert (thesis["type"], thesis["year"]) == ("thesis", 2017)
    pages = [ROOT / name for name in ("docs/reproduction.md", "calibration/README.md")]
    assert any(thesis["title"] in page.read_text("utf-8") for page in pages)
