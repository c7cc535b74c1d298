"""Licence and citation agree in the package, its metadata and CITATION.cff."""

from __future__ import annotations

import tomllib
from importlib import metadata

import pytest
from conftest import ROOT

import srs_twin
from srs_twin.io.documents import parse_yaml

pytestmark = pytest.mark.fast

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_installed_package_states_its_licence():
    about = metadata.metadata("srs-twin")
    assert about["License-Expression"] == PROJECT["license"] == "Apache-2.0"
    assert set(about.get_all("License-File")) == set(PROJECT["license-files"])
    for name in PROJECT["license-files"]:
        assert "Apache License" in (ROOT / name).read_text()


def test_citation_has_this_version_and_names_the_dissertation():
    document = parse_yaml((ROOT / "CITATION.cff").read_text("utf-8"), "CITATION.cff")
    document.raise_problems()
    assert document.get("version") == srs_twin.__version__ == PROJECT["version"]
    assert document.get("license") == PROJECT["license"]
    assert document.get("authors", 0, "name") == PROJECT["authors"][0]["name"]
    thesis = document.get("references", 0)
    assert thesis["type"] == "thesis" and thesis["year"] == 2017
    assert (
        thesis["title"]
        in (ROOT / "docs/reproduction.md").read_text("utf-8")
        + (ROOT / "calibration/README.md").read_text()
    )
