"""Former names of keys, kinds, options, columns and metrics lead to the current names."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from srs_twin import InputError, load_scenario
from srs_twin.errors import RENAMED, RenamedWarning, current_name, did_you_mean
from srs_twin.trajectory import Trajectory

FORMER = {
    "title": "a file with former names",
    "robot": "gen2",
    "duration_s": 1.0,
    "controller": {"kind": "gait", "frequency_hz": 1.0, "rest_share": 0.1},
    "plants": {"analytical": {"friction": "wheel", "load": "momentary"}},
    "expect": [
        {
            "metric": "com_speed_m_s",
            "plant": "analytical",
            "near": 9.0,
            "rel": 0.1,
            "known": "an example",
        }
    ],
}


def write(folder, document):
    path = folder / "former.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def test_file_with_former_names_equals_the_file_with_current_names(tmp_path):
    with pytest.warns(RenamedWarning) as caught:
        former = load_scenario(write(tmp_path, FORMER))
    assert {str(each.message) for each in caught} == {
        "rest_share is now called rest_fraction",
        "momentary is now called instantaneous",
        "known is now called expected_failure",
    }
    assert former.file.controller.rest_fraction == 0.1
    assert former.file.plants.analytical.load == "instantaneous"
    assert former.expect[0].expected_failure == "an example"


def test_former_name_beside_the_current_one_is_refused(tmp_path):
    both = {"kind": "gait", "rest_share": 0.1, "rest_fraction": 0.2}
    with pytest.raises(InputError, match="rest_share: unknown key; it is now called"):
        load_scenario(write(tmp_path, FORMER | {"controller": both}))


def test_former_name_where_the_current_one_is_unknown_is_an_unknown_key(tmp_path):
    with pytest.raises(InputError, match="rest_share: unknown key; allowed"):
        load_scenario(write(tmp_path, FORMER | {"supply": {"rest_share": 0.1}}))


def test_former_column_names_the_current_one():
    run = Trajectory(
        {"time": np.zeros(1), "connector_heading_1": np.zeros(1)}, metadata={}
    )
    with pytest.raises(KeyError, match="it is now called connector_heading_1"):
        run["theta_1"]


def test_former_option_is_used_with_a_warning(srs_twin, tmp_path):
    path = write(tmp_path, {key: FORMER[key] for key in ("title", "robot")})
    done = srs_twin("run", str(path), "--jobs", "0", cwd=tmp_path)
    assert done.returncode == 2
    assert "warning: --jobs is now called --workers" in done.stderr
    assert "Invalid value for '--workers'" in done.stderr


def test_former_names_lead_to_current_names_only():
    for former, current in RENAMED.items():
        assert current not in RENAMED
        assert current_name(former) == current
        assert did_you_mean(former, [current]) == f"; it is now called {current}"


def test_numbered_columns_keep_their_number():
    assert current_name("sensed_12") == "measured_bend_12"
    assert current_name("bend_12") is None
