"""The installed package states its licence."""

from __future__ import annotations

import tomllib
from importlib import metadata

import pytest
from conftest import ROOT

pytestmark = pytest.mark.fast

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_installed_package_states_its_licence():
    about = metadata.metadata("srs-twin")
    assert about["License-Expression"] == PROJECT["license"] == "Apache-2.0"
    assert set(about.get_all("License-File")) == set(PROJECT["license-files"])
    for name in PROJECT["license-files"]:
        assert "Apache License" in (ROOT / name).read_text()
