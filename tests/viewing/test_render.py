"""Videos and images rendered by MuJoCo from real runs, through the command line."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time

import mujoco
import numpy as np
import pytest
from matplotlib.image import imread

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


def alike(picture, rgb):
    """The share of pixels that have a colour's hue, in light and shade."""
    bright = picture[..., :3] / np.maximum(
        picture[..., :3].max(axis=-1, keepdims=True), 1
    )
    return (np.abs(bright - np.array(rgb) / max(rgb)).max(axis=-1) < 0.12).mean()


@pytest.mark.slow
def test_part_of_a_run_is_rendered(runs, srs_twin, tmp_path):
    words = (
        "render",
        str(runs / "gen2_straight"),
        "--video",
        "out.mp4",
        "--size",
        "128x72",
        "--fps",
        "5",
    )
    whole = ()
    part = ("--from", "1", "--to", "2")
    counts = []
    firsts = []
    for options in (whole, part):
        assert srs_twin(*words, *options, cwd=tmp_path).returncode == 0
        counts.append(len(frames(tmp_path / "out.mp4")))
        firsts.append(frames(tmp_path / "out.mp4")[0].astype(int))
    assert counts == [16, 6]
    # The snake has moved and bent since the start.
    assert np.abs(firsts[0] - firsts[1]).max() > 50


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ("--strobe", "--from", "30"),
            "the interval --from 30 --to 3 is outside the run; choose times from 0 to"
            " 3 s",
        ),
        (
            ("--strobe", "--from", "2", "--to", "1"),
            "the interval --from 2 --to 1 is outside the run",
        ),
        (
            ("--image", "t=1", "--to", "1"),
            "--from and --to apply only to --video and --strobe",
        ),
    ],
)
def test_part_outside_the_run_is_refused(runs, srs_twin, tmp_path, options, words):
    done = srs_twin("render", str(runs / "gen2_straight"), *options, cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.startswith(words)


@pytest.mark.slow
def test_video_shows_a_moving_snake(runs, srs_twin, tmp_path):
    done = srs_twin(
        *(
            "render",
            str(runs / "gen2_straight"),
            "--video",
            "out.mp4",
            "--size",
            "320x180",
            "--fps",
            "5",
        ),
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "out.mp4" and [
        p.name for p in tmp_path.iterdir()
    ] == ["out.mp4"]
    film_ = frames(tmp_path / "out.mp4")
    assert film_.shape == (16, 180, 320, 3), "3 s at 5 pictures a second, and the first"
    for rgb in (PLUS_RGB, MINUS_RGB):
        assert alike(film_[0], rgb) < 0.0002, "chambers are empty at the start"
        assert max(alike(each, rgb) for each in film_) > 0.002
    changed = (np.abs(np.diff(film_.astype(int), axis=0)).max(axis=-1) > 40).mean(
        axis=(1, 2)
    )
    assert (changed > 0.01).all(), "from each picture to the next the floor passes by"


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["gen2_straight", "follow_gen4_a", "module_step_iterative"]
)
def test_images_of_every_kind_of_run(runs, srs_twin, tmp_path, name):
    done = srs_twin(
        "render",
        str(runs / name),
        "--image",
        "t=0.5",
        "--size",
        "320x180",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    picture = imread(runs / name / f"{name}-0.5s.png")[..., :3] * 255
    assert picture.shape == (180, 320, 3)
    assert len(np.unique(picture.reshape(-1, 3).astype(int), axis=0)) > 500
    assert alike(picture, PLUS_RGB) + alike(picture, MINUS_RGB) > 0.002


@pytest.mark.slow
def test_the_strobe_figure_shows_the_snake_where_it_was(runs, opengl_here):
    """Its axes are metres: a body drawn without perspective covers the floor that its geometry says."""
    from srs_twin.viewing.mujoco.render import _floor_corners, _render_from_above

    run = load_run(runs / "gen2_straight")
    twin = run.trajectories["twin"]
    stage = Stage(run.scenario, twin)
    low, high = _floor_corners(run.scenario, twin)
    size = high - low
    wide = 400
    tall = 2 * round(wide * size[1] / size[0] / 2)
    rows = [0, len(twin) - 1]
    shown = _render_from_above(
        stage, rows, (low + high) / 2, float(size[1]), render.Size(wide, tall)
    ).astype(int)
    for row in rows:
        for x, y in (twin.position[row, 1:] + twin.position[row, :-1]) / 2:
            across = int((x - low[0]) / size[0] * wide)
            down = int((high[1] - y) / size[1] * tall)
            floor = shown[3, 3]
            assert np.abs(shown[down, across] - floor).max() > 25, (
                "the snake is drawn over the floor there"
            )
    beside = int((twin.position[0, 0, 0] - low[0]) / size[0] * wide), 3
    assert np.abs(shown[beside[1], beside[0]] - shown[3, 3]).max() < 40


def test_an_obstacle_does_not_hide_the_snake(runs, opengl_here):
    run = load_run(runs / "follow_gen4_a")
    stage = Stage(run.scenario, run.trajectories["twin"])
    row = len(stage.run) - 1
    circle = run.scenario.world.obstacles[0]
    place = np.array([circle.x, circle.y]) - stage.run.com[row]
    camera = FollowCamera(
        stage.run, run.scenario.robot.geometry.body_length, bench=False
    ).at(row)
    # A low camera behind the obstacle, which is in line with the snake.
    camera.azimuth = np.degrees(np.arctan2(-place[1], -place[0]))
    camera.elevation = -4.0
    camera.distance = float(np.hypot(*place)) + 3 * circle.radius
    obstacle = stage.model.geom("obstacle_1").id
    shown = {}
    with Canvas(stage.model, 320, 180) as canvas:
        for alpha in (stage.model.geom_rgba[obstacle, 3], 1.0):
            stage.model.geom_rgba[obstacle, 3] = alpha
            for color in ((1, 0, 0, 1), (0, 0, 1, 1)):
                stage.show(row)
                for geoms in stage._skins.geoms:
                    stage.model.geom_rgba[geoms] = color
                shown[alpha, color[0]] = canvas.draw(stage.data, camera).astype(int)
    seen = {
        alpha: np.abs(shown[alpha, 0] - shown[alpha, 1]).sum() for alpha, _ in shown
    }
    assert seen.pop(1.0) == 0, "an opaque one does hide it"
    assert min(seen.values()) > 1000


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


def test_strobe_from_the_command_line(runs, srs_twin, tmp_path):
    done = srs_twin(
        "render",
        str(runs / "gen2_straight"),
        "--strobe",
        "--size",
        "800x600",
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    picture = imread(done.stdout.strip())[..., :3] * 255
    assert picture.shape[1] == 800
    above_the_key = picture[:-100]
    assert alike(above_the_key, (0, 114, 178)) > 0.0005, "the trail is there"


def test_several_runs_go_into_a_folder(runs, srs_twin, tmp_path):
    names = ["gen2_straight", "module_step_iterative"]
    folders = [str(runs / name) for name in names]
    options = ("--size", "64x64", "--fps", "1", "-q")
    done = srs_twin("render", *folders, "--video", "films", *options, cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert sorted(p.name for p in (tmp_path / "films").iterdir()) == [
        f"{name}.mp4" for name in names
    ]


def test_camera_follows_smoothly(runs, opengl_here):
    run = load_run(runs / "gen2_straight")
    twin = run.trajectories["twin"]
    camera = FollowCamera(twin, run.scenario.robot.geometry.body_length, bench=False)
    at = np.array([camera.at(row).lookat.copy() for row in range(len(twin))])
    late = (twin.time > 1.0) & (
        twin.time < 2.5
    )  # at least half a period from both ends
    assert (
        np.abs(np.diff(at[late, 1])).max()
        < 0.2 * np.abs(np.diff(twin["com_y"][late])).max()
    )
    assert (
        np.hypot(*(at[:, :2] - twin.com).T).max()
        < 0.15 * run.scenario.robot.geometry.body_length
    )


def test_stage_restores_recorded_positions(runs, opengl_here):
    run = load_run(runs / "follow_gen4_a")
    twin = run.trajectories["twin"]
    stage = Stage(run.scenario, twin)
    for row in (0, 57, len(twin) - 1):
        stage.show(row)
        for i in (1, 5):
            x, y, _ = stage.data.body(f"connector_{i}").xpos
            assert (x, y) == pytest.approx(
                (twin[f"x_{i}"][row], twin[f"y_{i}"][row]), abs=1e-9
            )


@pytest.mark.slow
def test_contacts_of_a_spatial_snake_are_marked_up_to_the_time_of_the_picture(tmp_path):
    scenario = shortened("spatial_sidewinding", 1.0)
    run_scenario(scenario, tmp_path / "run", plants=["twin"])
    run = load_run(tmp_path / "run").trajectories["twin"]
    stage = Stage(scenario, run)
    counts = []
    for row in (0, 50, len(run) - 1):
        scene = mujoco.MjvScene(stage.model, maxgeom=5000)
        stage._add_marks(scene, row)
        counts.append(scene.ngeom)
        places = np.array([scene.geoms[k].pos[:2] for k in range(scene.ngeom)])
        places = places.reshape(-1, 2)
        touches = run.stack("load")[: row + 1] > 0.0
        assert len(places) == touches.sum()
        xy = np.stack([run.stack("x")[: row + 1], run.stack("y")[: row + 1]], axis=-1)
        assert places == pytest.approx(xy[touches], abs=1e-6)
    assert counts[0] < counts[1] < counts[2] < 0.8 * run.stack("load").size


@pytest.mark.slow
def test_a_ghost_a_scale_and_a_legend_are_in_the_picture(runs, opengl_here, tmp_path):
    """The orange body is where the other plant was; the boxes below are there with room for them alone."""
    run = load_run(runs / "gen2_straight")
    twin = run.trajectories["twin"]
    moved = {name: c + 0.25 * name.startswith("x_") for name, c in twin.columns.items()}
    ghost = Trajectory(moved | {"com_x": twin["com_x"] + 0.25}, metadata=twin.metadata)
    shown = {}
    for name, size in (
        ("wide", render.Size(640, 360)),
        ("narrow", render.Size(320, 180)),
    ):
        for given in (None, ("analytical", ghost)):
            path = tmp_path / "a.png"
            render.write_image(path, run.scenario, twin, 2.0, size=size, ghost=given)
            picture = imread(path)[..., :3] * 255
            shown[name, given is not None] = (
                picture[: int(0.93 * len(picture))],
                picture[-8:],
            )
    orange = {
        key: alike(above, STYLES["analytical"].rgb) for key, (above, _) in shown.items()
    }
    assert (
        min(orange["wide", True], orange["narrow", True])
        > 0.001
        > 5 * orange["wide", False]
    )
    assert alike(shown["wide", True][1], STYLES["analytical"].rgb) > 0.1
    assert (
        alike(shown["wide", False][1], PLUS_RGB)
        > 0.1
        > alike(shown["narrow", False][1], PLUS_RGB)
    )
    camera = FollowCamera(
        twin, run.scenario.robot.geometry.body_length, bench=False, ghost=ghost
    ).at(0)
    assert camera.lookat[0] == pytest.approx(twin.com[0, 0] + 0.125, abs=0.02)


def test_scale_bar_has_the_stated_length(runs, opengl_here):
    run = load_run(runs / "gen2_straight")
    stage = Stage(run.scenario, run.trajectories["twin"])
    camera = FollowCamera(
        stage.run, run.scenario.robot.geometry.body_length, bench=False
    ).at(0)
    scene = mujoco.MjvScene(stage.model, maxgeom=10)
    stage._add_scale_bar(scene, camera)
    (bar,) = scene.geoms[: scene.ngeom]
    assert bar.label == "0.1 m" and 2 * (bar.size[0] - bar.size[1]) == pytest.approx(
        0.1
    )


REFUSED = {
    "ghost on a strobe": (
        ("--strobe", "--ghost"),
        "--ghost requires --video or --image",
    ),
    "ghost of none": (
        ("--image", "1", "--ghost"),
        "the run contains no analytical model; remove --ghost",
    ),
    "nothing asked": (
        (),
        "exactly one of the options --video FILE.mp4, --image t=2.5 and --strobe",
    ),
    "two things asked": (
        ("--strobe", "--image", "1"),
        "exactly one of the options --video FILE.mp4, --image t=2.5 and --strobe",
    ),
    "out with a video": (
        ("--video", "a.mp4", "--out", "b.png"),
        "--out sets the output of images",
    ),
    "not a moment": (
        ("--image", "t=two"),
        "--image t=two is not a time; give seconds, for example t=2.5",
    ),
    "moment beyond": (
        ("--image", "t=20"),
        "t = 20 s is outside the run; choose a time from 0 to 3 s",
    ),
    "moment of none": (("--image", "nan"), "t = nan s is outside the run"),
    "odd size": (
        ("--strobe", "--size", "321x180"),
        "both even and between 64 and 4096",
    ),
    "size of words": (
        ("--strobe", "--size", "big"),
        "--size big is not allowed; give width and height in pixels",
    ),
    "another suffix": (
        ("--video", "a.avi"),
        "a.avi: the name of the file must end in .mp4",
    ),
    "no such size": (
        ("--strobe", "--size", "9999x9999"),
        "both even and between 64 and 4096",
    ),
}


@pytest.mark.default_cases(at=[0, 1, 2, 4, 5, 6, 10, 11])
@pytest.mark.parametrize("name", REFUSED)
def test_invalid_options_are_refused(runs, srs_twin, tmp_path, name):
    options, words = REFUSED[name]
    done = srs_twin("render", str(runs / "gen2_straight"), *options, cwd=tmp_path)
    assert done.returncode == 2 and words in done.stderr, done.stderr
    assert list(tmp_path.iterdir()) == []


def test_missing_run_is_refused(runs, srs_twin, tmp_path):
    done = srs_twin("render", "nowhere", "--strobe", cwd=tmp_path)
    assert (
        done.returncode == 2
        and "nowhere: no finished run was found (looked for" in done.stderr
    )
    alone = tmp_path / "alone"
    run_scenario(shortened("gen2_straight", 0.2), alone, plants=["analytical"])
    done = srs_twin("render", "alone", "--strobe", cwd=tmp_path)
    assert done.returncode == 2 and "alone: the run contains no twin" in done.stderr
    two = [str(runs / "gen2_straight"), str(runs / "follow_gen4_a")]
    done = srs_twin("render", *two, "--video", "a.mp4", cwd=tmp_path)
    assert (
        done.returncode == 2
        and "a.mp4: 2 runs cannot be written to one file; give a folder" in done.stderr
    )


def test_a_trajectory_of_another_robot_is_refused(runs):
    run = load_run(runs / "gen2_straight")
    other = load_run(runs / "module_step_iterative")
    with pytest.raises(
        InputError,
        match=r"columns qpos_1…, but the twin of the scenario has \d+ positions",
    ):
        Stage(run.scenario, other.trajectories["twin"])
    columns = {
        k: v
        for k, v in run.trajectories["twin"].columns.items()
        if not k.startswith("qpos")
    }
    with pytest.raises(InputError, match="contains no positions of the twin"):
        Stage(run.scenario, Trajectory(columns))


@pytest.mark.slow
@pytest.mark.usefixtures("interruptible")
def test_interrupt_leaves_no_files(runs, tmp_path):
    script = os.path.join(os.path.dirname(sys.executable), "srs-twin")
    command = [
        script,
        "render",
        str(runs / "gen2_straight"),
        "--video",
        "out.mp4",
        "--fps",
        "120",
    ]
    started = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 600
    while not list(tmp_path.glob(".out.*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert list(tmp_path.glob(".out.*")), "it has begun to write"
    started.send_signal(signal.SIGINT)
    _, said = started.communicate(timeout=300)
    assert started.returncode == 130 and "Traceback" not in said
    assert list(tmp_path.iterdir()) == []


def test_failed_video_keeps_the_existing_file(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"earlier")
    with (
        pytest.raises(RuntimeError),
        render.video_writer(path, width=64, height=64, fps=1) as add,
    ):
        add(np.zeros((64, 64, 3), dtype=np.uint8))
        raise RuntimeError
    assert path.read_bytes() == b"earlier" and list(tmp_path.iterdir()) == [path]
    with (
        pytest.raises(InputError, match="cannot be written"),
        render.video_writer(tmp_path / "a.mp4/b.mp4", width=64, height=64, fps=1),
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
@pytest.mark.parametrize("name", ["egl", "osmesa"])
def test_egl_and_osmesa_draw_equal_images(runs, name, tmp_path):
    """Two implementations, one picture; whichever is chosen, a run looks alike."""
    if opengl._test(name):
        pytest.skip(f"{name} does not draw here")
    code = (
        "import sys, numpy as np\nfrom srs_twin.experiment import load_run\nfrom"
        " srs_twin.viewing.mujoco.render import Size, write_image\nrun ="
        " load_run(sys.argv[1])\nwrite_image(__import__('pathlib').Path('p.png'),"
        " run.scenario, run.trajectories['twin'], 2.0, size=Size(160, 90))"
    )
    environment = {**os.environ, "MUJOCO_GL": name}
    command = [sys.executable, "-c", code, str(runs / "gen2_straight")]
    subprocess.run(command, check=True, cwd=tmp_path, env=environment)
    run = load_run(runs / "gen2_straight")
    stage = Stage(run.scenario, run.trajectories["twin"])
    camera = FollowCamera(
        stage.run, run.scenario.robot.geometry.body_length, bench=False
    )
    with Canvas(stage.model, 160, 90) as canvas:
        row = stage.row_at(2.0)
        ours = stage.render(canvas, camera.at(row), row).astype(int)
    theirs = imread(tmp_path / "p.png")[..., :3] * 255
    assert np.abs(ours - theirs).mean() < 3.0


@pytest.mark.slow
def test_unclosed_canvas_is_freed_silently_at_exit(opengl_here):
    program = (
        "import mujoco\n"
        "from srs_twin.viewing.mujoco.canvas import Canvas\n"
        "model = mujoco.MjModel.from_xml_string('<mujoco/>')\n"
        f"canvas = Canvas(model, 32, 32, opengl={opengl_here!r})\n"
        "print(canvas.draw(mujoco.MjData(model), mujoco.MjvCamera()).shape)\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "(32, 32, 3)\n", "")
