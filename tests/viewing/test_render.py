"""Videos and images rendered by MuJoCo from real runs, through the command line."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import wait_until
from matplotlib.image import imread
from processes import python

from srs_twin import load_scenario
from srs_twin.errors import InputError, WriteError
from srs_twin.experiment import load_run, run_scenario
from srs_twin.scenario.loading import parse_scenario
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.mujoco import opengl, render
from srs_twin.viewing.mujoco.canvas import Canvas, Label
from srs_twin.viewing.mujoco.render import FollowCamera
from srs_twin.viewing.mujoco.stage import Stage
from srs_twin.viewing.plots.style import MINUS_RGB, PLUS_RGB, STYLES

av = pytest.importorskip("av")


@pytest.fixture(scope="module")
def opengl_here():
    try:
        return opengl.usable_opengl()
    except InputError as error:
        pytest.skip(str(error))


def shortened(name, duration, **changes):
    document = (
        dict(load_scenario(name).document)
        | {"duration_s": duration, "expect": []}
        | changes
    )
    return parse_scenario(document, name=name)


@pytest.fixture(scope="module")
def runs(tmp_path_factory, opengl_here):
    """Folders of short runs: a gait, one among obstacles, a module on a bench."""
    folder = tmp_path_factory.mktemp("runs")
    for scenario in (
        shortened("gen2_straight", 3.0),
        shortened("follow_gen4_a", 3.0),
        shortened("module_step_iterative", 0.6),
    ):
        run_scenario(scenario, folder / scenario.name, plants=["twin"])
    return folder


def frames(path):
    with av.open(str(path)) as container:
        return np.stack(
            [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        )


@pytest.fixture
def rendered(runs, srs_twin, tmp_path):
    """Return a function that runs `render` with the run of a scenario."""

    def run(*options, of="gen2_straight"):
        return srs_twin("render", str(runs / of), *options, cwd=tmp_path)

    return run


def staged(folder):
    """Return a finished run and the stage of its twin."""
    run = load_run(folder)
    return run, Stage(run.scenario, run.trajectories["twin"])


def following(run, ghost=None):
    """Return the camera that follows the twin of a run."""
    length = run.scenario.robot.geometry.body_length
    return FollowCamera(run.trajectories["twin"], length, bench=False, ghost=ghost)


def alike(picture, rgb):
    """The share of pixels that have a colour's hue, in light and shade."""
    bright = picture[..., :3] / np.maximum(
        picture[..., :3].max(axis=-1, keepdims=True), 1
    )
    return (np.abs(bright - np.array(rgb) / max(rgb)).max(axis=-1) < 0.12).mean()


@pytest.mark.slow
def test_video_shows_a_moving_snake(rendered, tmp_path):
    words = ("--video", "out.mp4", "--size", "320x180", "--fps", "5")
    done = rendered(*words)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "out.mp4"
    assert [path.name for path in tmp_path.iterdir()] == ["out.mp4"]
    film = frames(tmp_path / "out.mp4")
    assert film.shape == (16, 180, 320, 3), "3 s at 5 pictures a second, and the first"
    for rgb in (PLUS_RGB, MINUS_RGB):
        assert alike(film[0], rgb) < 0.0002, "chambers are empty at the start"
        assert max(alike(each, rgb) for each in film) > 0.002
    steps = np.abs(np.diff(film.astype(int), axis=0)).max(axis=-1)
    changed = (steps > 40).mean(axis=(1, 2))
    assert (changed > 0.01).all(), "from each picture to the next the floor passes by"
    assert rendered(*words, "--from", "1", "--to", "2").returncode == 0
    part = frames(tmp_path / "out.mp4").astype(int)
    assert len(part) == 6
    # The snake has moved and bent since the start.
    assert np.abs(part[0] - film[0]).max() > 50


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["gen2_straight", "follow_gen4_a", "module_step_iterative"]
)
def test_images_of_every_kind_of_run(runs, rendered, name):
    done = rendered("--image", "t=0.5", "--size", "320x180", of=name)
    assert done.returncode == 0, done.stderr
    picture = imread(runs / name / f"{name}-0.5s.png")[..., :3] * 255
    assert picture.shape == (180, 320, 3)
    assert len(np.unique(picture.reshape(-1, 3).astype(int), axis=0)) > 500
    assert alike(picture, PLUS_RGB) + alike(picture, MINUS_RGB) > 0.002


@pytest.mark.slow
def test_the_strobe_figure_shows_the_snake_where_it_was(runs):
    """Its axes are metres: a body drawn without perspective covers the floor that its geometry says."""
    run, stage = staged(runs / "gen2_straight")
    twin = run.trajectories["twin"]
    low, high = render._floor_corners(run.scenario, twin)
    size = high - low
    wide = 400
    tall = 2 * round(wide * size[1] / size[0] / 2)
    rows = [0, len(twin) - 1]
    shown = render._render_from_above(
        stage, rows, (low + high) / 2, float(size[1]), render.Size(wide, tall)
    ).astype(int)
    floor = shown[3, 3]
    for row in rows:
        for x, y in (twin.position[row, 1:] + twin.position[row, :-1]) / 2:
            across = int((x - low[0]) / size[0] * wide)
            down = int((high[1] - y) / size[1] * tall)
            assert np.abs(shown[down, across] - floor).max() > 25, (
                "the snake is drawn over the floor there"
            )
    across = int((twin.position[0, 0, 0] - low[0]) / size[0] * wide)
    assert np.abs(shown[3, across] - floor).max() < 40


def test_an_obstacle_does_not_hide_the_snake(runs):
    run, stage = staged(runs / "follow_gen4_a")
    row = len(stage.run) - 1
    circle = run.scenario.world.obstacles[0]
    place = np.array([circle.x, circle.y]) - stage.run.com[row]
    camera = following(run).at(row)
    # A low camera behind the obstacle, which is in line with the snake.
    camera.azimuth = np.degrees(np.arctan2(-place[1], -place[0]))
    camera.elevation = -4.0
    camera.distance = float(np.hypot(*place)) + 3 * circle.radius
    obstacle = stage.model.geom("obstacle_1").id

    def visible(canvas, alpha):
        """Return the sum of changes when the body changes its colour."""
        stage.model.geom_rgba[obstacle, 3] = alpha
        pictures = []
        for color in ((1, 0, 0, 1), (0, 0, 1, 1)):
            stage.show(row)
            for geoms in stage._skins.geoms:
                stage.model.geom_rgba[geoms] = color
            pictures.append(canvas.draw(stage.data, camera).astype(int))
        return np.abs(pictures[0] - pictures[1]).sum()

    with Canvas(stage.model, 320, 180) as canvas:
        assert visible(canvas, stage.model.geom_rgba[obstacle, 3]) > 1000
        assert visible(canvas, 1.0) == 0, "an opaque one does hide it"


@pytest.mark.parametrize(("width", "shown"), [(479, 1), (480, 2)])
def test_from_480_pixels_on_labels_are_drawn_side_by_side(opengl_here, width, shown):
    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with Canvas(model, width, 64, opengl=opengl_here) as canvas:
        plain = canvas.draw(data, mujoco.MjvCamera()).astype(int)
        labels = [Label("", "#ff0000"), Label("", "#0000ff")]
        drawn = canvas.draw(data, mujoco.MjvCamera(), labels=labels).astype(int)
    changed = np.abs(drawn - plain).sum(axis=(0, 2)) > 0
    halves = changed[: width // 2], changed[-(width // 2) :]
    assert sum(bool(half.any()) for half in halves) == shown


def test_strobe_from_the_command_line(rendered):
    done = rendered("--strobe", "--size", "800x600")
    assert done.returncode == 0, done.stderr
    picture = imread(done.stdout.strip())[..., :3] * 255
    assert picture.shape[1] == 800
    above_the_key = picture[:-100]
    assert alike(above_the_key, (0, 114, 178)) > 0.0005, "the trail is there"


def test_several_runs_go_into_a_folder(runs, srs_twin, tmp_path):
    names = ["gen2_straight", "module_step_iterative"]
    folders = [str(runs / name) for name in names]
    options = ("--size", "64x64", "--fps", "1", "--speed", "0.5", "-q")
    done = srs_twin("render", *folders, "--video", "films", *options, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    films = sorted((tmp_path / "films").iterdir())
    assert [film.name for film in films] == [f"{name}.mp4" for name in names]
    # Runs of 3 s and 0.6 s last 6 s and 1.2 s in slow motion, and begin with a frame.
    assert [len(frames(film)) for film in films] == [7, 2]


def test_camera_follows_smoothly(runs):
    run = load_run(runs / "gen2_straight")
    twin = run.trajectories["twin"]
    camera = following(run)
    at = np.array([camera.at(row).lookat.copy() for row in range(len(twin))])
    # At least half a period from both ends.
    late = (twin.time > 1.0) & (twin.time < 2.5)
    sway = np.abs(np.diff(twin["com_y"][late])).max()
    assert np.abs(np.diff(at[late, 1])).max() < 0.2 * sway
    apart = np.hypot(*(at[:, :2] - twin.com).T)
    assert apart.max() < 0.15 * run.scenario.robot.geometry.body_length
    # The camera looks to the left, and from farther away if a ghost is ahead.
    view = np.radians(camera.at(0).azimuth) - twin["heading"][0]
    assert np.sin(view) > 0.8
    ghost = replace(twin, columns={**twin.columns, "com_x": twin["com_x"] + 0.25})
    both = following(run, ghost).at(0)
    assert both.lookat[0] == pytest.approx(at[0, 0] + 0.125)
    assert both.distance == pytest.approx(camera.at(0).distance + 0.7 * 0.25)


def test_stage_restores_recorded_positions(runs):
    run, stage = staged(runs / "follow_gen4_a")
    twin = run.trajectories["twin"]
    for row in (0, 57, len(twin) - 1):
        stage.show(row)
        for i in (1, 5):
            place = stage.data.body(f"connector_{i}").xpos[:2]
            assert place == pytest.approx(twin.position[row, i - 1], abs=1e-9)
    early, late = twin.time[57:59]
    assert [stage.row_at(early + k * (late - early)) for k in (0.4, 0.6)] == [57, 58]


def test_floor_around_obstacles_and_goal_has_a_margin_of_0_35_body_lengths(runs):
    run = load_run(runs / "follow_gen4_a")
    world = run.scenario.world
    low, high = render._floor_corners(run.scenario, run.trajectories["twin"])
    ends = [run.trajectories["twin"].position.reshape(-1, 2)]
    for item in (*world.obstacles, world.goal):
        centre = np.array([item.x, item.y])
        ends += [[centre - item.radius, centre + item.radius]]
    margin = 0.35 * run.scenario.robot.geometry.body_length
    points = np.concatenate(ends)
    size = np.ptp(points, axis=0) + 2 * margin
    size[0] = max(size)
    assert high - low == pytest.approx(size)
    assert low + high == pytest.approx(points.min(axis=0) + points.max(axis=0))


@pytest.mark.slow
def test_contacts_of_a_spatial_snake_are_marked_up_to_the_time_of_the_picture(tmp_path):
    scenario = shortened("spatial_sidewinding", 1.0)
    run_scenario(scenario, tmp_path / "run", plants=["twin"])
    run = load_run(tmp_path / "run").trajectories["twin"]
    stage = Stage(scenario, run)
    touches = run.stack("load") > 0.0
    counts = []
    for row in (0, 50, len(run) - 1):
        scene = mujoco.MjvScene(stage.model, maxgeom=5000)
        stage._add_marks(scene, row)
        counts.append(scene.ngeom)
        places = [scene.geoms[k].pos[:2] for k in range(scene.ngeom)]
        expected = run.position[: row + 1][touches[: row + 1]]
        assert np.reshape(places, (-1, 2)) == pytest.approx(expected, abs=1e-6)
    assert counts[0] < counts[1] < counts[2] < 0.8 * touches.size


@pytest.mark.slow
def test_a_ghost_a_scale_and_a_legend_are_in_the_picture(runs, tmp_path):
    """The orange body is where the other plant was."""
    run = load_run(runs / "gen2_straight")
    twin = run.trajectories["twin"]
    moved = {name: c + 0.25 * name.startswith("x_") for name, c in twin.columns.items()}
    ghost = Trajectory(moved | {"com_x": twin["com_x"] + 0.25}, metadata=twin.metadata)
    orange = STYLES["analytical"].rgb

    def shown(ghost=None):
        """Return the picture without its legend, and the legend."""
        path = tmp_path / "a.png"
        size = render.Size(640, 360)
        render.write_image(path, run.scenario, twin, 2.0, size=size, ghost=ghost)
        picture = imread(path)[..., :3] * 255
        return picture[:334], picture[-8:]

    plain, plain_key = shown()
    both, both_key = shown(("analytical", ghost))
    assert alike(both, orange) > 0.001 and alike(plain, orange) < 0.0002
    assert alike(both_key, orange) > 0.1 and alike(plain_key, PLUS_RGB) > 0.1


def test_scale_bar_has_the_stated_length(runs):
    run, stage = staged(runs / "gen2_straight")
    scene = mujoco.MjvScene(stage.model, maxgeom=10)
    stage._add_scale_bar(scene, following(run).at(0))
    (bar,) = scene.geoms[: scene.ngeom]
    assert bar.label == "0.1 m"
    assert 2 * (bar.size[0] - bar.size[1]) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--strobe", "--ghost"), "--ghost requires --video or --image"),
        (("--image", "1", "--ghost"), "the run contains no analytical model; remove"),
        ((), "exactly one of the options --video FILE.mp4, --image t=2.5 and --strobe"),
        (("--strobe", "--image", "1"), "exactly one of the options --video FILE.mp4"),
        (("--video", "a.mp4", "--out", "b.png"), "--out sets the output of images"),
        (
            ("--image", "t=two"),
            "--image t=two is not a time; give seconds, for example t=2.5",
        ),
        (
            ("--image", "t=20"),
            "t = 20 s is outside the run; choose a time from 0 to 3 s",
        ),
        (("--image", "nan"), "t = nan s is outside the run"),
        (("--strobe", "--size", "321x180"), "both even and between 64 and 4096"),
        (("--strobe", "--size", "4098x64"), "both even and between 64 and 4096"),
        (
            ("--strobe", "--size", "big"),
            "--size big is not allowed; give width and height in pixels",
        ),
        (("--video", "a.avi"), "a.avi: the name of the file must end in .mp4"),
        (
            ("--strobe", "--from", "30"),
            "from 30 to 3 s has fewer than two samples; choose --from and a later --to",
        ),
        (
            ("--strobe", "--from", "2", "--to", "1"),
            "from 2 to 1 s has fewer than two samples",
        ),
        (
            ("--image", "t=1", "--to", "1"),
            "--from and --to apply only to --video and --strobe",
        ),
    ],
)
def test_invalid_options_are_refused(rendered, tmp_path, options, words):
    done = rendered(*options)
    assert done.returncode == 2 and words in done.stderr, done.stderr
    assert list(tmp_path.iterdir()) == []


def test_runs_that_cannot_be_rendered_are_refused(runs, srs_twin, tmp_path):
    brief = shortened("gen2_straight", 0.2)
    run_scenario(brief, tmp_path / "alone", plants=["analytical"])
    two = [str(runs / "gen2_straight"), str(runs / "follow_gen4_a")]
    for words, said in (
        (["nowhere", "--strobe"], "nowhere: no finished run was found (looked for"),
        (["alone", "--strobe"], "alone: the run contains no twin"),
        (
            [*two, "--video", "a.mp4"],
            "a.mp4: 2 runs cannot be written to one file; give a folder",
        ),
    ):
        done = srs_twin("render", *words, cwd=tmp_path)
        assert done.returncode == 2 and said in done.stderr


def test_a_trajectory_of_another_robot_is_refused(runs):
    run = load_run(runs / "gen2_straight")
    other = load_run(runs / "module_step_iterative").trajectories["twin"]
    with pytest.raises(
        InputError,
        match=r"columns qpos_1…, but the twin of the scenario has \d+ positions",
    ):
        Stage(run.scenario, other)
    columns = {k: v for k, v in other.columns.items() if not k.startswith("qpos")}
    with pytest.raises(InputError, match="contains no positions of the twin"):
        Stage(run.scenario, Trajectory(columns))


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
def test_interrupt_leaves_no_files(runs, tmp_path):
    script = Path(sys.executable).with_name("srs-twin")
    words = ["render", runs / "gen2_straight", "--video", "out.mp4", "--fps", "120"]
    started = subprocess.Popen(
        [script, *words], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    wait_until(lambda: list(tmp_path.glob(".out.*")))
    started.send_signal(signal.SIGINT)
    _, said = started.communicate(timeout=300)
    assert started.returncode == 130 and "Traceback" not in said
    assert list(tmp_path.iterdir()) == []


def test_failed_video_keeps_the_existing_file(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"earlier")
    size = {"width": 64, "height": 64, "fps": 1}
    with pytest.raises(RuntimeError), render.video_writer(path, **size) as add:
        add(np.zeros((64, 64, 3), dtype=np.uint8))
        raise RuntimeError
    assert path.read_bytes() == b"earlier" and list(tmp_path.iterdir()) == [path]
    with (
        pytest.raises(InputError, match="cannot be written"),
        render.video_writer(path / "b.mp4", **size),
    ):
        raise AssertionError("not reached")


def test_video_on_a_full_disk_is_a_write_error(tmp_path, monkeypatch):
    def full(*_, **__):
        raise av.FFmpegError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(av, "open", full)
    with (
        pytest.raises(WriteError, match="the video cannot be written .*No space"),
        render.video_writer(tmp_path / "a.mp4", width=64, height=64, fps=1),
    ):
        raise AssertionError("not reached")


def test_missing_encoder_names_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(
        InputError, match=r"the encoder PyAV.*uv sync --extra video.*srs-twin\[video\]"
    ):
        render.encoder()


def test_failing_opengl_backend_is_named(runs, srs_twin_process, tmp_path):
    done = srs_twin_process(
        "render",
        str(runs / "gen2_straight"),
        "--strobe",
        cwd=tmp_path,
        MUJOCO_GL="vulkan",
    )
    assert done.returncode == 2
    assert (
        "OpenGL backend selected by MUJOCO_GL does not work (vulkan: unknown backend"
        in done.stderr
    )


def test_without_opengl_the_error_names_packages(monkeypatch):
    monkeypatch.setattr(opengl, "_test", lambda name: f"no lib{name}")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    with pytest.raises(InputError) as caught:
        opengl.usable_opengl.__wrapped__()
    assert (
        str(caught.value)
        == "no OpenGL backend can render off screen (egl: no libegl; osmesa: no"
        " libosmesa); on Debian and Ubuntu, install a backend with apt-get install"
        " libegl1 libgl1-mesa-dri; or apt-get install libosmesa6"
    )


@pytest.mark.slow
def test_unclosed_canvas_is_freed_silently_at_exit(opengl_here):
    program = (
        "import mujoco\n"
        "from srs_twin.viewing.mujoco.canvas import Canvas\n"
        "model = mujoco.MjModel.from_xml_string('<mujoco/>')\n"
        f"canvas = Canvas(model, 32, 32, opengl={opengl_here!r})\n"
        "print(canvas.draw(mujoco.MjData(model), mujoco.MjvCamera()).shape)\n"
    )
    ended = python("-c", program)
    assert (ended.stdout, ended.stderr) == ("(32, 32, 3)\n", "")
