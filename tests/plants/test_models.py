"""Exported MJCF: current, in the layout of Menagerie, equal to the twin's model, usable in MuJoCo alone."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from srs_twin import PreloadedContact, load_robot
from srs_twin.errors import InputError
from srs_twin.plants.twin.mjcf.export import (
    SCENE,
    SCENE_MJX,
    _add_lags,
    export_robot,
    robot_files,
)
from srs_twin.plants.twin.mjcf.model import GRAVITY, scene_mjcf
from srs_twin.plants.twin.mjcf.numerics import ModelSettings
from srs_twin.plants.twin.mjcf.wheels import preload_force

pytestmark = pytest.mark.default_cases(3)

ROBOTS = ("gen1", "gen2", "gen3", "gen4")
SECOND = round(1 / ModelSettings.timestep)

# A program without the package: a file, MuJoCo, and one second of random control
# through valves.
PLAIN = """
import sys, numpy as np, mujoco
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
rng = np.random.default_rng(int(sys.argv[2]))
fill_time = float(sys.argv[3])
for step in range(round(1 / model.opt.timestep)):
    if step % 20 == 0:
        target = rng.uniform(*model.actuator_ctrlrange.T)
    data.ctrl += (target - data.ctrl) * model.opt.timestep / fill_time
    mujoco.mj_step(model, data)
assert not data.warning.number.any(), data.warning.number
for name in ("qpos", "qvel", "qacc", "sensordata"):
    assert np.isfinite(getattr(data, name)).all(), name
assert not [name for name in sys.modules if name.startswith("srs_twin")]
print(np.abs(data.ten_length).max())
"""


@pytest.fixture(params=ROBOTS)
def spec(request):
    return load_robot(request.param)


@pytest.fixture
def shipped(root, spec):
    return mujoco.MjModel.from_xml_path(str(root / "models" / spec.name / SCENE))


def at_home(model):
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    return data


def test_shipped_mjcf_files_are_current(root, spec, tmp_path):
    written = export_robot(spec, tmp_path)
    assert [path.name for path in written] == [f"{spec.name}.xml", SCENE, SCENE_MJX]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        path.name for path in written
    )
    for path in written:
        assert path.read_text("utf-8") == (
            root / "models" / spec.name / path.name
        ).read_text("utf-8")


def with_lags(spec):
    """Return the scene of the twin, with the second actuators of exported models where they are needed."""
    scene = scene_mjcf(spec, ModelSettings(contact=PreloadedContact()))
    _add_lags(scene, spec)
    return scene.compile()


def test_exported_files_compile_to_the_model_of_the_twin_bit_for_bit(spec, shipped):
    twin = with_lags(spec)
    for part in ("opt", "stat", "vis"):
        assert str(getattr(twin, part)) == str(getattr(shipped, part)), part
    compared = set()
    for name in dir(twin):
        ours = getattr(twin, name)
        # The models are called 'gen2' and 'gen2 scene', which shifts the addresses of
        # all names.
        if isinstance(ours, np.ndarray) and not name.startswith(("_", "name")):
            np.testing.assert_array_equal(getattr(shipped, name), ours, err_msg=name)
            compared.add(name)
    assert compared >= {
        "body_mass",
        "jnt_axis",
        "dof_frictionloss",
        "actuator_biasprm",
        "pair_friction",
    }
    assert [twin.actuator(i).name for i in range(twin.nu)] == [
        shipped.actuator(i).name for i in range(twin.nu)
    ]


@pytest.mark.default_cases(1)
@pytest.mark.parametrize("name", ROBOTS)
def test_exported_model_is_stable_under_random_control(root, tmp_path, name):
    fill_time = str(load_robot(name).actuator.tau_fill)
    command = [
        sys.executable,
        "-c",
        PLAIN,
        str(root / "models" / name / SCENE),
        "7",
        fill_time,
    ]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) > 0.1  # rad: it did bend
    assert list(tmp_path.iterdir()) == []  # no MUJOCO_LOG.TXT


def test_home_keyframe_rests_with_weight_and_preload_on_the_floor(spec, shipped):
    data = at_home(shipped)
    home = data.qpos.copy()
    for _ in range(SECOND):
        mujoco.mj_step(shipped, data)
    assert np.abs(data.qvel).max() < 1e-5
    assert np.abs(data.qpos[:3] - home[:3]).max() < 1e-3
    force = data.sensordata[: 6 * spec.geometry.connectors].reshape(-1, 2, 3).copy()
    force[..., 2] -= preload_force(spec, PreloadedContact())
    np.testing.assert_allclose(
        force.sum(axis=(0, 1)), [0, 0, spec.mass.total * GRAVITY], atol=1e-6
    )
    # The wheels of a connector share its own weight evenly; a flexible body passes on
    # little.
    np.testing.assert_allclose(
        force[..., 2].sum(axis=1),
        spec.mass.array() * GRAVITY,
        atol=0.05 * spec.mass.total * GRAVITY,
    )


def test_robot_file_contains_the_robot_only(root, spec):
    robot = mujoco.MjModel.from_xml_path(
        str(root / "models" / spec.name / f"{spec.name}.xml")
    )
    assert (robot.npair, robot.nsensor, robot.nlight, robot.ntex) == (0, 0, 0, 0)
    assert robot.key("home").qpos.shape == (robot.nq,)
    assert not (robot.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).any()


def test_files_have_the_layout_of_menagerie(spec):
    texts = robot_files(spec)
    robot = texts[f"{spec.name}.xml"]
    scene = texts[SCENE]
    assert "`srs-twin models export`" in robot and f"'{spec.name}'" in robot
    assert f'<include file="{spec.name}.xml"/>' in scene
    for text in texts.values():
        assert text.endswith("</mujoco>\n")
        indents = [
            len(line) - len(line.lstrip(" "))
            for line in text.splitlines()
            if line.lstrip()[:1] == "<"
        ]
        assert {indent % 2 for indent in indents} == {0}
        tree = ElementTree.fromstring(text)
        unnamed = {"inertial", "default", "include"}
        for section in (
            "worldbody",
            "contact",
            "actuator",
            "sensor",
            "keyframe",
            "asset",
        ):
            for element in tree.iterfind(f"./{section}//*"):
                assert element.tag in unnamed or element.get("name"), (
                    ElementTree.tostring(element)
                )
    tree = ElementTree.fromstring(robot)
    assert all(element.get("name") for element in tree.iterfind("./tendon/*"))
    classes = {item.get("class") for item in tree.iter("default")}
    assert classes >= {
        "hinge",
        "pitch",
        "roll",
        "axle",
        "tread",
        "rim",
        "skin",
        "plate",
        "muscle",
        "press",
    }
    for tag, repeated in (
        ("joint", "stiffness"),
        ("geom", "contype"),
        ("general", "ctrlrange"),
    ):
        own = [
            item
            for section in ("worldbody", "actuator")
            for item in tree.iterfind(f"./{section}//{tag}")
        ]
        assert own and not [item for item in own if item.get(repeated)], (tag, repeated)
    ours = ElementTree.fromstring(scene)
    theirs = {"compiler", "option", "tendon", "actuator", "keyframe"}
    assert not theirs & {section.tag for section in ours}


def test_title_is_escaped_in_the_comment(tmp_path):
    wild = dataclasses.replace(
        load_robot("gen2"), title="a --> <body/> <!-- 'b' & \"c\""
    )
    export_robot(wild, tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / SCENE))
    assert (
        model.nbody
        == scene_mjcf(wild, ModelSettings(contact=PreloadedContact())).compile().nbody
    )


def test_unwritable_folder_is_an_input_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        export_robot(load_robot("gen2"), tmp_path / "file")


def test_models_command_exports_and_checks(srs_twin, tmp_path):
    done = srs_twin("models", "export", "gen2", "gen4", "--out", "here", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (
        0,
        "here/gen2/scene.xml\nhere/gen4/scene.xml\n",
    )
    left_out = (
        "gen4: actuator.tau_fill_s = 0.1107 s is left out, because the controls are"
        " pressures, which change instantly"
    )
    assert left_out in done.stderr.splitlines()
