"""Keys of provenances, and the words that say what has changed."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pydantic import TypeAdapter

from srs_twin.io.provenance import Provenance

pytestmark = pytest.mark.fast

RUN = Provenance(
    {"robot": {"mass": {"value": 1.0}}, "plants": ("twin",)},
    files={"map.png": "aa"},
    sources={"srs_twin.control.gait": "bb"},
    versions={"mujoco": "3.16.0"},
)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"versions": {"mujoco": "3.17.0"}}, "mujoco 3.17.0, was 3.16.0"),
        (
            {"sources": {"srs_twin.control.gait": "cc"}},
            "srs_twin.control.gait changed",
        ),
        ({"files": {"map.png": "cc"}}, "map.png changed"),
        (
            {"content": {**RUN.content, "robot": {"mass": {"value": 2.0}}}},
            "robot.mass.value 2.0, was 1.0",
        ),
        (
            {"content": {"plants": ["twin"]}},
            "robot null, was {mass: {value: 1.0}}",
        ),
    ],
)
def test_a_change_of_each_part_changes_the_key_and_is_named(change, words):
    changed = replace(RUN, **change)
    assert changed.key != RUN.key
    assert changed.difference(RUN) == words


def test_a_renamed_file_keeps_the_key():
    assert replace(RUN, files={"copy.png": "aa"}).key == RUN.key


def test_a_stored_provenance_is_equal_to_the_original():
    stored = TypeAdapter(Provenance).validate_json(RUN.text)
    assert stored.key == RUN.key
    assert stored.difference(RUN) == ""


def test_a_long_value_is_not_written_out():
    long = Provenance({"values": [0.5] * 40})
    assert long.difference(Provenance({"values": []})) == "values changed"


def test_a_whole_number_is_equal_to_the_float():
    settings = Provenance({"supply_pa": 48300})
    assert Provenance({"supply_pa": 48300.0}).difference(settings) == ""
