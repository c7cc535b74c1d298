"""Footprints: published tables, interpolation, transients and invalid files."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given, strategies as st

from srs_twin.errors import InputError, InputFileError
from srs_twin.io.files import shipped_folder, shipped_names
from srs_twin.planning.footprint import Footprint, Transient, validate_footprint
from srs_twin.planning.footprint_file import (
    load_footprint,
    load_footprint_file,
    save_footprint,
)

# Table 8 as printed: offset, speed, left, right, radius.
TABLE_8 = (
    (0, 0.1345, -0.1, 0.1, 4.467),
    (0.1, 0.1524, -0.08, 0.1, 1.8157),
    (0.2, 0.1082, -0.07, 0.1, 1.2532),
    (0.3, 0.1216, -0.06, 0.09, 0.7856),
    (-0.1, 0.1696, -0.11, 0.08, 1.7707),
    (-0.2, 0.1489, -0.09, 0.06, 0.8445),
    (-0.3, 0.1471, -0.09, 0.055, 0.6727),
)
BOX = Footprint.box(0.05, 0.01, speed=0.2, curvature=math.pi / 3 / 0.2)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("row", TABLE_8, ids=lambda row: str(row[0]))
def test_shipped_table_8_equals_the_printed_table(row):
    offset, speed, left, right, radius = row
    body = load_footprint("gen4_table8")
    curvature = body.curvatures[body.offsets.index(offset)]
    assert 1 / abs(curvature) == pytest.approx(radius, rel=1e-4)
    assert curvature * offset >= 0
    motion = body.at(curvature)
    assert (motion.offset, motion.speed, motion.left, motion.right) == pytest.approx(
        (offset, speed, -left, right)
    )


def test_shipped_boxes_are_those_of_the_dissertation():
    text = load_footprint("gen2_section52")
    for column in ("curvatures", "speeds", "left", "right"):
        assert getattr(text, column) == pytest.approx(getattr(BOX, column), abs=1e-5)
    table_9 = load_footprint("gen4_table9")
    assert math.degrees(table_9.tightest[0] * 0.12) == pytest.approx(9, abs=1e-3)
    assert [
        a + b for a, b in zip(table_9.left, table_9.right, strict=True)
    ] == pytest.approx([0.25] * 3)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("name", shipped_names("footprint"))
def test_shipped_footprints_are_valid_and_round_trip(name, tmp_path):
    file = load_footprint_file(name)
    validate_footprint(file.footprint())
    save_footprint(file, tmp_path / "again.yaml")
    assert load_footprint_file(tmp_path / "again.yaml") == file


@given(st.floats(0, 1))
def test_rows_are_interpolated_linearly(fraction):
    body = load_footprint("gen4_table8")
    k = body.curvatures[4] + fraction * (body.curvatures[5] - body.curvatures[4])
    motion = body.at(k)
    assert motion.speed == pytest.approx(0.1524 + fraction * (0.1082 - 0.1524))
    assert motion.left == pytest.approx(0.08 - fraction * 0.01)


def test_the_box_shifts_outward():
    turn = BOX.at(BOX.curvatures[-1])
    assert (turn.left, turn.right) == pytest.approx((0.015, 0.035))
    assert BOX.narrowest == pytest.approx(0.015)


def test_curvature_beyond_the_table_is_rejected():
    with pytest.raises(
        InputError,
        match="the curvature 6 1/m is not allowed; the footprint covers curvatures"
        " between -5.23599 and 5.23599",
    ):
        BOX.at(6.0)


def test_transients_grow_with_the_change_and_depend_on_its_direction():
    body = replace(
        BOX,
        transients=(
            Transient(-0.3, 0.3, 0.0, 0.02, 0.1),
            Transient(0.0, 0.3, 0.0, 0.015, 0.08),
        ),
    )
    assert body.transient(-0.3, 0.3) == pytest.approx((0, 0.02, 0.1))
    assert body.transient(-0.15, 0.15) == pytest.approx((0, 0.015, 0.1))
    assert body.transient(0.0, 0.15) == pytest.approx((0, 0.0075, 0.1))
    assert body.transient(0.3, -0.3) == (0, 0, 0)
    assert body.transient(0.1, 0.1) == (0, 0, 0)


def test_response_and_lag_follow_from_the_measured_changes():
    """The turn lags by Δκ ℓ, and the path is displaced by Δκ m/2 with T = m/δ."""
    body = replace(
        Footprint.box(0.05, 0.0, speed=0.2, curvature=3.0),
        transients=(
            Transient(0.0, 0.3, 0.0, 0.0, 0.1, dy=3 * 0.009 / 2, dheading=-3 * 0.06),
            Transient(-0.3, 0.3, 0.0, 0.0, 0.1, dy=0.0, dheading=-6 * 0.08),
        ),
    )
    least_squares = (3 * 3 * 0.06 + 6 * 6 * 0.08) / (3**2 + 6**2)
    assert body.response_length == pytest.approx(least_squares)
    assert body.lag(0.0, 0.3) == pytest.approx((0.06, 0.009 / 0.06))
    assert body.lag(-0.3, 0.3) == pytest.approx((0.08, 0.08))
    assert body.lag(-0.15, 0.3) == pytest.approx((0.07, (0.15 + 0.08) / 2))
    assert body.lag(0.3, 0.0) == (0.0, 0.0)
    assert BOX.response_length is None and BOX.lag(0.0, 0.3) == (0.0, 0.0)


def test_widest_of_equally_large_changes_counts():
    body = replace(
        BOX,
        transients=(
            Transient(-0.3, 0.0, 0.01, 0.02, 0.1),
            Transient(0.0, 0.3, 0.02, 0.01, 0.2),
            Transient(-0.2, 0.1, 0.0, 0.03, 0.05),
        ),
    )
    for before, after in ((-0.3, 0.0), (0.0, 0.3), (-0.1, 0.2)):
        assert body.transient(before, after) == pytest.approx((0.02, 0.03, 0.2))
    assert body.transient(0.0, 0.15) == pytest.approx((0.01, 0.015, 0.2))


def test_edges_may_reach_the_centre_of_their_turn():
    """A long snake in a tight turn has an outer edge farther away than the centre on the other side."""
    body = replace(
        BOX,
        curvatures=(-13.0, 0.0, 13.0),
        left=(0.085, 0.05, 0.047),
        right=(0.047, 0.05, 0.085),
    )
    assert validate_footprint(body) is body
    with pytest.raises(
        InputError,
        match=r"left: 0.08 m reaches the centre of the tightest turn, radius 0.0769",
    ):
        validate_footprint(replace(body, left=(0.085, 0.05, 0.08)))
    # A change to the left that pushes the right edge out does not narrow the inside of
    # a left turn.
    out = Transient(-0.3, 0.3, 0.0, 0.06, 0.1)
    assert validate_footprint(replace(body, transients=(out,)))
    with pytest.raises(InputError, match=r"left: 0.107 m reaches"):
        validate_footprint(replace(body, transients=(replace(out, left=0.06),)))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "[-0.3, 0.0, 0.3]",
            "[0.3, 0.0, -0.3]",
            "5:17: offset.value: the values must increase from row to row",
        ),
        ("[0.12, 0.12, 0.12]", "[0.12, 0.12]", "must have at least 3 entries, not 2"),
        (
            "[0.12, 0.12, 0.12]",
            "[0.12, 0.12, 0.12, 0.12]",
            "speed_m_s.value: 4 values are given for 3 offsets; give one value for each",
        ),
        (
            "[0.175, 0.125, 0.075]",
            "[0.8, 0.8, 0.8]",
            "left_m.value: 0.8 m reaches the centre of the tightest turn",
        ),
        ("[-1.309, 0.0, 1.309]", "[0.1, 0.2, 1.309]", "needs turns to both sides"),
        (
            "[-1.309, 0.0, 1.309]",
            "[-1.309, .nan, 1.309]",
            "curvature_per_m.value[1]: must be",
        ),
    ],
)
def test_invalid_footprint_files_are_rejected_with_their_place(
    old, new, words, tmp_path
):
    text = (shipped_folder("footprint") / "gen4_table9.yaml").read_text("utf-8")
    assert old in text
    (tmp_path / "x.yaml").write_text(text.replace(old, new, 1), "utf-8")
    with pytest.raises(InputFileError) as error:
        load_footprint(tmp_path / "x.yaml")
    assert words in str(error.value)


def test_unknown_footprint_error_lists_the_names():
    with pytest.raises(
        InputError, match="unknown footprint 'gen4_table7'; did you mean gen4_table"
    ):
        load_footprint("gen4_table7")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"speeds": (0.2, 0.0, 0.2)},
            "speeds and the edges `left` and `right` must be above 0",
        ),
        ({"ahead": -0.1}, "`ahead` and `behind` at least 0"),
        ({"left": (0.02, math.nan, 0.02)}, "all values must be finite"),
        (
            {"curvatures": (-1.0, 1.0, 0.5)},
            "curvatures: the values must increase from row to row",
        ),
        (
            {"transients": (Transient(0, 0.3, 0.2, 0, 0.1),)},
            "reaches the centre of the tightest turn",
        ),
    ],
)
def test_footprints_from_code_are_checked_as_well(changes, words):
    with pytest.raises(InputError, match=words):
        validate_footprint(replace(BOX, **changes))


def test_reversing_a_footprint_twice_restores_it():
    body = replace(load_footprint("gen4_table8"), ahead=0.2, behind=0.1)
    back = body.backward
    assert back.backward == body
    assert (back.ahead, back.behind) == (0.1, 0.2)
    for k in body.curvatures:
        there = body.at(k)
        here = back.at(-k)
        assert (here.left, here.right) == (there.right, there.left)
        assert (here.offset, here.speed) == (-there.offset, there.speed)
