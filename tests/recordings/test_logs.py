"""Recordings of a motion: true values are recovered, identities are kept, changes are noted."""

from __future__ import annotations

import hashlib
import re
from dataclasses import replace

import numpy as np
import pytest
from recorded import NOISE, RATE, SPEC, motion, plain_csv, recorded, true_at, wrapped
from scipy.interpolate import CubicSpline
from snakes import chain
from subsets import first_by_default
from synthetic import backwards, moved, sampled, with_columns
from synthetic_takes import Take, motive_csv, write_motive

from srs_twin import AnalyticalSnake, Gait, InputError, Trajectory, rollout
from srs_twin.recordings.body.floor import MAPS, map_to_floor
from srs_twin.recordings.recording import read_motion

LAYOUTS = ("single", "head", "pair")


def near(one, other, most):
    """Compare large arrays without the slow difference report of pytest."""
    assert np.abs(np.asarray(one) - other).max() < most


def errors(recording, truth):
    """Return errors of positions (m), bends and headings (rad), and which samples were measured."""
    trajectory = recording.trajectory
    true = true_at(trajectory, truth)
    place = np.linalg.norm(trajectory.position - true.position, axis=-1)
    bend = trajectory.stack("bend") - true.stack("bend")
    heading = wrapped(trajectory["heading"] - true["heading"])
    return place, bend, heading, trajectory.stack("filled") == 0


@pytest.mark.parametrize(
    ("layout", "most"), [("single", 0.03), ("head", 0.002), ("pair", 1e-4)]
)
def test_motion_without_noise_is_recovered(tmp_path, layout, most):
    """With one marker per connector, the straight start leaves an error of 20 mrad."""
    truth = moved(motion(), 1.7, -0.4, 2.5)
    found = recorded(tmp_path, Take(layout=layout, noise=0.0), truth)
    place, bend, heading, measured = errors(found, truth)
    assert measured.all()
    assert len(found.trajectory) == len(truth)
    assert place.max() < 1e-6
    assert np.abs(bend).max() < most
    assert np.abs(heading).max() < most
    near(found.trajectory.com, truth.com, 1e-6)


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("seed", first_by_default(1, range(4)))
def test_identity_is_kept_through_swaps_gaps_and_spikes(tmp_path, layout, seed):
    """Every measured sample belongs to its marker, and interpolated ones are flagged."""
    take = Take(layout=layout, swaps=30, lost=0.05, spikes=4, seed=seed)
    found = recorded(tmp_path, take)
    place, _, _, measured = errors(found, motion())
    assert len(found.trajectory) > 0.9 * len(motion())
    assert place[measured].max() < 8 * NOISE
    assert found.summary.markers.moves >= 15
    assert (
        0.03 < found.summary.samples_filled / found.summary.markers.samples_seen < 0.08
    )
    assert 0 < (~measured).mean() < 0.15


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("seed", first_by_default(1, range(3)))
def test_markers_that_come_back_in_other_columns_are_tracked(tmp_path, layout, seed):
    found = recorded(
        tmp_path, Take(layout=layout, lost=0.03, fragments=True, seed=seed)
    )
    place, _, _, measured = errors(found, motion())
    assert found.summary.markers.columns > 12
    assert place[measured].max() < 8 * NOISE


@pytest.mark.parametrize("rate", first_by_default(1, [120.0, 30.0, 60.0, 240.0]))
def test_motion_is_recovered_at_any_frame_rate(tmp_path, rate):
    found = recorded(tmp_path, Take(layout="pair", rate_hz=rate, swaps=10, noise=0.0))
    assert found.summary.rate_hz == pytest.approx(rate, rel=1e-6)
    true = CubicSpline(motion().time, motion().stack("bend"))(found.trajectory.time)
    near(found.trajectory.stack("bend"), true, 0.01)


@pytest.mark.parametrize("up", MAPS)
def test_floor_coordinates_are_a_rotation_of_the_axes_of_the_file(up):
    axes = np.eye(3)[:, None]
    turned = map_to_floor(axes, up, "z", level=False).points[:, 0]
    assert np.linalg.det(turned) == pytest.approx(1.0)
    height = np.zeros(3)
    height["xyz".index(up[-1])] = -1 if up[0] == "-" else 1
    assert turned[:, 2].tolist() == height.tolist()


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("up", sorted(MAPS))
def test_the_vertical_axis_is_determined(tmp_path, up):
    take = Take(layout="head", noise=0.0, digits=9, up=up, unit="in")
    found = recorded(tmp_path, take)
    place, bend, _, _ = errors(found, motion())
    assert found.summary.markers.up == up
    assert place.max() < 1e-5
    assert np.abs(bend).max() < 0.002
    assert "lengths were converted from in to m" in found.summary.corrections


def test_reversed_vertical_axis_mirrors_the_motion(tmp_path):
    """The opposite sign of the vertical axis corrects an export with mirrored axes."""
    right = recorded(tmp_path, Take(layout="head", noise=0.0)).trajectory
    mirrored = recorded(tmp_path, Take(layout="head", noise=0.0), up="-y").trajectory
    near(mirrored.stack("bend"), -right.stack("bend"), 1e-9)
    near(mirrored["y_1"], -right["y_1"], 1e-9)


@pytest.mark.parametrize(
    ("degrees", "levelled"), [(2.9, False), (3.1, True), (29.5, True), (31, None)]
)
def test_a_floor_tilted_by_3_to_30_degrees_is_levelled(degrees, levelled):
    random = np.random.default_rng(0)
    moved = random.uniform(-1, 1, (300, 1, 3)) + random.uniform(-0.1, 0.1, (300, 4, 3))
    flat = moved * [1.0, 1.0, 1e-4] + [0.0, 0.0, 0.02]
    c = np.cos(np.radians(degrees))
    s = np.sin(np.radians(degrees))
    tilted = flat @ np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    if levelled is None:
        with pytest.raises(InputError, match="is tilted by 31° from all axes"):
            map_to_floor(tilted, "auto", "z")
        return
    found = map_to_floor(tilted, "auto", "z")
    assert found.up == "z"
    assert (f"the floor was levelled by {degrees}°" in found.corrections) == levelled
    assert (np.ptp(found.points[..., 2]) < 0.01) == levelled


def test_pairs_across_the_body_are_read(tmp_path):
    found = recorded(tmp_path, Take(layout="pair", across=True, noise=0.0))
    near(found.trajectory.stack("bend"), motion().stack("bend"), 1e-4)


def test_the_given_head_is_used(tmp_path):
    """For a snake that crawls tail first, the motion alone would give the wrong end."""
    take = Take(labeled=True, noise=0.0)
    tail_first = backwards(motion())
    guessed, told = (
        recorded(tmp_path, take, tail_first, head=head) for head in (None, "snake:1")
    )
    near(told.trajectory["x_1"], tail_first["x_1"], 1e-6)
    near(guessed.trajectory["x_5"], tail_first["x_1"], 1e-6)
    assert told.summary.markers.head == "marker 'snake:1'"
    assert "crawled" in guessed.summary.markers.head
    with pytest.raises(InputError, match="unknown marker 'snake:9'"):
        recorded(tmp_path, take, tail_first, head="snake:9")
    with pytest.raises(
        InputError, match="marker 'snake:3' is at neither end of the body"
    ):
        recorded(tmp_path, take, tail_first, head="snake:3")


def test_a_recording_without_crawling_needs_the_head(tmp_path):
    still = sampled(motion(), np.zeros(len(motion()), dtype=int))
    still = with_columns(still, time=motion().time)
    said = r"crawled only 0[.\d]* mm along its axis \(at least 22 mm are needed"
    with pytest.raises(InputError, match=said):
        recorded(tmp_path, Take(), still)


def test_long_gaps_cut_the_recording(tmp_path):
    take = Take(layout="pair", occluded=[(3, 1.0, 1.5)])
    found = recorded(tmp_path, take)
    assert found.trajectory.time[0] == pytest.approx(1.5)
    assert found.trajectory.stack("filled").max() == 0
    assert (
        f"{len(motion()) - len(found.trajectory)} left out at the ends"
        in found.summary.text()
    )
    often = [(3, 0.4 * k, 0.4 * k + 0.3) for k in range(10)]
    said = (
        r"no 12 successive frames contain all 10 markers with gaps of at most 0\.2 s\."
        r" All markers are visible in 25 % of the 401 frames at 100 Hz"
    )
    with pytest.raises(InputError, match=said):
        recorded(tmp_path, Take(layout="pair", occluded=often))
    bridged = recorded(tmp_path, take, longest_gap_s=0.6)
    assert len(bridged.trajectory) == len(motion())
    flags = bridged.trajectory.stack("filled")
    assert flags.sum() == 50 and flags.sum(axis=0).max() == 50
    assert bridged.summary.markers.longest_filled_s == pytest.approx(0.51)


def test_short_gaps_are_filled_within_a_millimetre(tmp_path):
    take = Take(layout="head", noise=0.0, lost=0.02, gap_frames=1.0)
    place, _, _, measured = errors(recorded(tmp_path, take), motion())
    assert 1e-9 < place[~measured].max() < 3e-3
    assert np.sqrt((place[~measured] ** 2).mean()) < 1e-3


def test_reflections_are_removed_and_counted(tmp_path):
    text = motive_csv(motion(), Take(noise=1e-4, unit="m"))
    lines = text.split("\r\n")
    extra = [
        ",Marker" * 6,
        ",ghost" * 3 + ",lamp" * 3,
        ",7" * 3 + ",8" * 3,
        ",Position" * 6,
        ",X,Y,Z" * 2,
    ]
    for line, more in zip(range(2, 7), extra, strict=True):
        lines[line] += more
    for k in range(7, len(lines) - 1):
        lines[k] += ",0.3,0.03,5.0" + (",0.1,1.5,0.1" if k % 40 == 0 else ",,,")
    path = tmp_path / "x.csv"
    path.write_text("\n".join(lines))
    found = read_motion(path, SPEC)
    assert found.summary.markers.layout == "single"
    assert found.summary.markers.samples_other == len(motion()) + len(
        range(40, len(lines) - 1, 40)
    )
    place, _, _, measured = errors(found, motion())
    assert measured.all() and place.max() < 1e-3


def test_shuffled_repeated_and_missing_rows_are_corrected(tmp_path):
    text = motive_csv(motion(), Take(layout="pair", noise=0.0))
    lines = text.split("\r\n")
    header = lines[:7]
    rows = lines[7:-1]
    random = np.random.default_rng(3)
    kept = np.delete(np.arange(len(rows)), [100, 101, 250])
    order = np.append(random.permutation(kept), [40, 41])
    path = tmp_path / "x.csv"
    path.write_text("\n".join([*header, *(rows[k] for k in order), ""]))
    found = read_motion(path, SPEC)
    said = "; ".join(found.summary.corrections)
    for words in ("sorted", "2 rows were left out, because", "3 frames are missing in"):
        assert words in said
    assert found.summary.markers.frames_missing == 3
    assert found.summary.markers.header_frames == len(rows)
    for words in ("(401 according to the header)", " 0 left out at the ends"):
        assert words in found.summary.text()
    place, _, _, measured = errors(found, motion())
    assert len(found.trajectory) == len(rows) and place[measured].max() < 1e-6
    assert np.flatnonzero(~measured.all(axis=1)).tolist() == [100, 101, 250]


@pytest.mark.parametrize("cut", [1, 40])
def test_a_truncated_last_line_is_left_out_with_a_note(tmp_path, cut):
    text = motive_csv(motion(), Take(layout="pair", noise=0.0))
    path = tmp_path / "x.csv"
    path.write_text(text[: -2 - cut], newline="")
    found = read_motion(path, SPEC)
    assert found.summary.frames_read == len(motion()) - 1
    assert any("may be cut off" in each for each in found.summary.corrections)
    near(found.trajectory.stack("bend"), motion().stack("bend")[:-1], 1e-4)


@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("cm", 1e2)])
def test_plain_csv_is_read(tmp_path, unit, scale):
    path = tmp_path / "plain.csv"
    path.write_text(plain_csv(motion(), unit, scale))
    found = read_motion(path, SPEC)
    near(found.trajectory.position, motion().position, 1e-6)
    near(found.trajectory.stack("bend"), motion().stack("bend"), 0.03)
    assert found.summary.markers.head == "connector 1 of the file"


@pytest.mark.parametrize(
    ("unit", "scale", "apart", "hint"),
    [
        ("m", 1e3, r"5\.011e\+04 to 1\.9e\+05", "in"),
        ("mm", 1.0, "0.05011 to 0.19", "not in"),
    ],
)
def test_plain_csv_in_a_wrong_unit_is_refused(tmp_path, unit, scale, apart, hint):
    path = tmp_path / "plain.csv"
    path.write_text(plain_csv(motion(), unit, scale))
    with pytest.raises(
        InputError,
        match=rf"the markers are {apart} mm apart, .* 55 mm apart; check the unit,"
        rf" because the lengths seem to be {hint} mm",
    ):
        read_motion(path, SPEC)


def test_another_robot_is_refused(tmp_path):
    from srs_twin import load_robot

    path = tmp_path / "plain.csv"
    path.write_text(plain_csv(motion()))
    with pytest.raises(
        InputError,
        match=r"the connectors of gen4 .* mm apart; check that the recording belongs"
        r" to this robot",
    ):
        read_motion(path, load_robot("gen4"))


def test_lengths_of_longer_segments_are_measured(tmp_path):
    """With one marker per connector, the bends depend on the lengths, which are estimated with them."""
    geometry = replace(SPEC.geometry, rigid_gap=SPEC.geometry.rigid_gap - 0.003)
    path = tmp_path / "plain.csv"
    path.write_text(plain_csv(motion()))
    found = read_motion(path, replace(SPEC, geometry=geometry))
    assert any(
        each.startswith("the segment lengths differ from those of gen2 by +2.")
        for each in found.summary.corrections
    )
    assert (
        np.sqrt(((found.trajectory.stack("bend") - motion().stack("bend")) ** 2).mean())
        < 0.05
    )


@pytest.mark.parametrize("connectors", [2, 9])
def test_bodies_with_other_numbers_of_segments_are_read(tmp_path, connectors):
    spec = chain((0.03,) * connectors)
    truth = rollout(
        AnalyticalSnake(spec, supply_pa=48e3), Gait(2.0, 0.1), 1.0, record_hz=RATE
    )
    path = tmp_path / "x.csv"
    write_motive(truth, Take(layout="head", noise=0.0), path)
    found = read_motion(path, spec, layout="head").trajectory
    whole = (found.stack("filled") == 0).all(axis=1)
    assert whole.mean() > 0.7
    near(found.stack("bend")[whole], truth.stack("bend")[whole], 0.01)
    write_motive(truth, Take(layout="single", noise=0.0, labeled=True), path)
    if connectors < 4:
        with pytest.raises(InputError, match="put a second marker on the head"):
            read_motion(path, spec, head="snake:1")


def test_metadata_and_units(tmp_path):
    found = recorded(tmp_path, Take(layout="pair"), gait_frequency_hz=2.0)
    about = found.trajectory.metadata
    assert (
        about["source"]["sha256"]
        == hashlib.sha256((tmp_path / "take.csv").read_bytes()).hexdigest()
    )
    assert (about["source"]["file"], about["plant"], about["robot"]) == (
        "take.csv",
        "measured",
        "gen2",
    )
    assert about["source"]["corrections"] == list(found.summary.corrections)
    assert about["record_hz"] == pytest.approx(RATE)
    assert about["duration_s"] == pytest.approx(4.0)
    assert about["gait_frequency_hz"] == 2.0
    for key in ("body_length_m", "segment_length_m", "rigid_gap_m", "mass_kg"):
        assert about[key] == pytest.approx(motion().metadata[key])
    assert about["velocity_half_width"] == 5
    # The noise has a standard deviation of 0.2 mm.
    for note in (
        "up is y: markers stay within 0.2 mm of a plane",
        "the axes are rotated: floor x is X of the file, and floor y is −Z of the file",
    ):
        assert note in found.summary.corrections
    units = {
        re.sub(r"_\d+$", "", name): found.trajectory.unit(name)
        for name in found.trajectory.columns
    }
    assert units == {
        "time": "s",
        "com_x": "m",
        "com_y": "m",
        "heading": "rad",
        "x": "m",
        "y": "m",
        "connector_heading": "rad",
        "bend": "rad",
        "com_velocity_x": "m/s",
        "com_velocity_y": "m/s",
        "yaw_rate": "rad/s",
        "bend_rate": "rad/s",
        "bend_error": "rad",
        "length": "m",
        "filled": "1",
        "residual": "m",
    }
    path = tmp_path / "x.parquet"
    found.trajectory.to_parquet(path)
    again = Trajectory.from_parquet(path)
    assert again.metadata == about and list(again.columns) == list(
        found.trajectory.columns
    )


def test_velocities_of_a_recording_are_slopes_of_its_positions(tmp_path):
    """They agree in the mean over gait periods; within a period the moving line attenuates them."""
    found = recorded(tmp_path, Take(layout="pair"), gait_frequency_hz=2.0).trajectory
    period = round(RATE / 2.0)
    for rate, place in (
        ("com_velocity_x", "com_x"),
        ("com_velocity_y", "com_y"),
        ("yaw_rate", "heading"),
    ):
        for start in (50, 150, 250):
            moved = found[place][start + period] - found[place][start]
            assert found[rate][start : start + period].mean() * 0.5 == pytest.approx(
                moved, abs=0.002
            )


def test_summary_counts_every_sample(tmp_path):
    """Every visible sample is kept, rejected, of another marker, or outside the kept frames."""
    recording = recorded(
        tmp_path, Take(layout="single", lost=0.05, spikes=6, swaps=5, seed=5)
    )
    found = recording.summary
    counts = found.markers
    kept = found.frames_kept * 5 - found.samples_filled
    gone = counts.samples_rejected + counts.samples_other
    outside = counts.samples_seen - kept - gone
    assert 0 <= outside <= 5 * (found.frames_read - found.frames_kept)
    # Five markers have three coordinates per frame.
    cells = np.genfromtxt(tmp_path / "take.csv", delimiter=",", skip_header=7)[:, 2:]
    assert cells.shape == (401, 15)
    assert counts.samples_seen == np.isfinite(cells).sum() / 3
    for line in (
        f"read: 401 frames, 5 columns of positions, 100 Hz, {counts.samples_seen} positions",
        f"column changes: {counts.moves}",
        f"rejected: {counts.samples_rejected} outliers, {counts.samples_other} positions",
        f"kept: {found.frames_kept} frames, {found.start:g} s to {found.end:g} s",
        f"markers: layout single; head: {counts.head}; up: y",
        f"filled: {found.samples_filled} positions, longest gap"
        f" {counts.longest_filled_s:.3g} s",
        f"quantile): {', '.join(f'{1000 * each:.1f}' for each in counts.spacing_m)} mm;"
        f" distance of the markers from the body {1000 * counts.residual_m:.2g} mm RMS,"
        f" noise {1000 * counts.noise_m:.2g} mm",
        f"standard error of a bend: {counts.bend_error_rad:.2g} rad",
    ):
        assert line in found.text()
    for name, rms in (("bend_error", "bend_error_rad"), ("residual", "residual_m")):
        values = np.array(
            [
                recording.trajectory[key]
                for key in recording.trajectory.columns
                if key.startswith(name)
            ]
        )
        assert getattr(counts, rms) == pytest.approx(np.sqrt((values**2).mean()))
    steps = np.linalg.norm(np.diff(recording.trajectory.position, axis=1), axis=-1)
    assert counts.spacing_m == pytest.approx(np.quantile(steps, 0.98, axis=0))
