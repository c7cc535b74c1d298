"""Check of untrusted models: faults are reported with reasons, and resources are limited."""

from __future__ import annotations

import json
import os
from pathlib import Path

import mujoco
import pytest

from srs_twin.errors import InputError
from srs_twin.plants.twin.mjcf import check as checks
from srs_twin.plants.twin.mjcf.check import check_mjcf, examine_model, scan_mjcf

BALL = (
    '<worldbody><geom type="plane" size="1 1 1"/>'
    '<body pos="0 0 .2"><freejoint/><geom size=".1"/></body></worldbody>'
)

BALL_ALONE = '<body pos="0 0 .2"><freejoint/><geom size=".1"/></body>'


@pytest.fixture
def check(tmp_path):
    def write_and_check(inside, **options):
        path = tmp_path / "model.xml"
        path.write_text(f"<mujoco>{inside}</mujoco>")
        return check_mjcf(path, **options)

    return write_and_check


def test_valid_model_passes_with_its_sizes(check):
    report = check(BALL)
    assert report.faults == ()
    assert report.sizes["bodies"] == report.sizes["joints"] == 1
    assert report.sizes["mass_kg"] == pytest.approx(
        1000 * 4 / 3 * 3.141592653589793 * 0.1**3
    )


@pytest.mark.parametrize(
    ("inside", "words"),
    [
        (
            f'<option timestep="nan"/>{BALL}',
            "timestep nan s is not allowed; it must be 1e-05 to 0.1 s",
        ),
        (
            BALL.replace('size=".1"', 'size=".1" friction="-1 0 0"'),
            "geom_friction[1] has a negative value",
        ),
        (BALL.replace('pos="0 0 .2"', 'pos="0 0 nan"'), "not finite"),
        ("<worldbody><body>", "not readable as XML"),
        (
            "<worldbody><bod/></worldbody>",
            "does not compile: XML Error: Schema violation",
        ),
        (
            '<include file="../../x.xml"/>',
            "line 1: <include> names '../../x.xml', outside the model's folder",
        ),
        ('<asset><mesh file="/etc/passwd"/></asset>', "outside the model's folder"),
        (
            (
                '<worldbody><body><joint/><geom size=".1"/></body></worldbody>'
                '<actuator><motor joint="" gear="1e30"/></actuator>'
            ),
            "does not compile",
        ),
    ],
)
def test_each_fault_is_reported(check, inside, words):
    report = check(inside)
    assert any(words in fault for fault in report.faults), report.faults


def test_references_of_included_files_are_checked(check, tmp_path):
    (tmp_path / "part.xml").write_text(
        '<mujoco><include file="/tmp/elsewhere.xml"/></mujoco>'
    )
    (fault,) = check('<include file="part.xml"/>').faults
    assert fault.startswith(
        "part.xml:1: <include> names '/tmp/elsewhere.xml', outside the model's folder"
    )


def test_random_control_detects_an_unstable_model(check):
    report = check(
        '<worldbody><body><joint name="j" armature="1e-6"/><geom size=".01"'
        ' mass="1e-6"/></body></worldbody><actuator><motor joint="j"'
        ' gear="1e9"/></actuator>'
    )
    assert any("random control raised the warning" in fault for fault in report.faults)


@pytest.mark.slow
def test_endless_model_is_stopped_by_the_time_limit(check):
    # Spheres in one another: nothing is wrong with the file, but every step has 300,000
    # contacts.
    endless = f'<worldbody><replicate count="800">{BALL_ALONE}</replicate></worldbody>'
    report = check(endless, time_limit_s=3)
    assert len(report.faults) == 1
    assert "3 s" in report.faults[0]


def test_missing_file_is_an_input_error(tmp_path):
    with pytest.raises(
        InputError,
        match="no such file; give an MJCF or URDF file, or the name of a shipped",
    ):
        check_mjcf(tmp_path / "none.xml")


TETRAHEDRON = (
    "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
)
SECRET = "secret_of_another_folder"


def mjcf(file, head=""):
    """Return a free body with one mesh."""
    return (
        f'<mujoco>{head}<asset><mesh name="m" file="{file}"/></asset><worldbody><body'
        ' name="b"><freejoint/><geom type="mesh" mesh="m"'
        ' mass="1"/></body></worldbody></mujoco>'
    )


def link(name, inside=""):
    inertia = '<inertia ixx="1e-3" ixy="0" ixz="0" iyy="1e-3" iyz="0" izz="1e-3"/>'
    return (
        f'<link name="{name}"><inertial><mass'
        f' value=".4"/>{inertia}</inertial>{inside}</link>'
    )


def urdf(file=None, compiler="", *, base=True, use="collision"):
    """Return a base and one link on a hinge, with a mesh for each file name."""
    mesh = (
        f'<{use}><geometry><mesh filename="{file}"/></geometry></{use}>' if file else ""
    )
    hinge = (
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1"'
        ' velocity="1"/></joint>'
    )
    joint = (
        '<joint name="j" type="revolute"><parent link="base"/><child'
        f' link="next"/>{hinge}'
    )
    return (
        "<robot"
        f' name="r"><mujoco>{compiler}</mujoco>{link("base") if base else ""}{link("next", mesh)}'
        + (f"{joint}</robot>" if base else "</robot>")
    )


def laid_out(folder, files):
    """Write the files of a package and return the first, the model; a path as content creates a link."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, Path):
            path.symlink_to(content)
        else:
            path.write_text(content.replace("PACKAGE", str(folder)))
    return (folder / next(iter(files))).resolve()


UP = '<compiler meshdir="../meshes"/>'
MESH = {"meshes/t.obj": TETRAHEDRON}
STRIP = '<compiler strippath="true" meshdir="../meshes"/>'
ATTACH = (
    '<mujoco><asset><model name="x" file="../parts/p.xml"/></asset>'
    '<worldbody><attach model="x" body="b" prefix="p_"/></worldbody></mujoco>'
)
INSIDE = {
    "mesh folder": {"mjcf/m.xml": mjcf("t.obj", UP), **MESH},
    "asset folder": {
        "mjcf/m.xml": mjcf("t.obj", '<compiler assetdir="../meshes"/>'),
        **MESH,
    },
    "mesh file": {"mjcf/m.xml": mjcf("../meshes/t.obj"), **MESH},
    "backslashes": {"mjcf/m.xml": mjcf("..\\meshes\\t.obj"), **MESH},
    "deep and back": {
        "mjcf/m.xml": mjcf("../../../meshes/t.obj", '<compiler meshdir="a/b"/>'),
        **MESH,
    },
    "absolute": {"mjcf/m.xml": mjcf("PACKAGE/meshes/t.obj"), **MESH},
    "absolute folder": {
        "mjcf/m.xml": mjcf("t.obj", '<compiler meshdir="PACKAGE/meshes"/>'),
        **MESH,
    },
    "out and in": {"mjcf/m.xml": mjcf("../../pkg/meshes/t.obj"), **MESH},
    "link": {
        "mjcf/m.xml": mjcf("l.obj"),
        **MESH,
        "mjcf/l.obj": Path("../meshes/t.obj"),
    },
    "include": {
        "mjcf/m.xml": '<mujoco><include file="../p.xml"/></mujoco>',
        "p.xml": mjcf("meshes/t.obj"),
        **MESH,
    },
    "chain of includes": {
        "mjcf/m.xml": '<mujoco><include file="../parts/p.xml"/></mujoco>',
        "parts/p.xml": '<mujoco><include file="q.xml"/></mujoco>',
        "parts/q.xml": mjcf("../meshes/t.obj"),
        **MESH,
    },
    "attached": {"mjcf/m.xml": ATTACH, "parts/p.xml": mjcf("t.obj", UP), **MESH},
    "URDF": {"urdf/m.urdf": urdf("../meshes/t.obj"), **MESH},
    "URDF of a package": {
        "urdf/m.urdf": urdf("package://pkg/meshes/t.obj", STRIP),
        **MESH,
    },
    "URDF, discarded visual": {
        "urdf/m.urdf": urdf("package://pkg/meshes/none.dae", use="visual")
    },
}


@pytest.mark.parametrize("name", INSIDE)
def test_files_in_the_parent_folder_are_allowed(name, tmp_path):
    path = laid_out(tmp_path / "pkg", INSIDE[name])
    assert scan_mjcf(path) == []
    model = mujoco.MjModel.from_xml_path(str(path))
    result = examine_model(path, 30, 0.01)
    assert result["faults"] == []
    numbers = {
        "bodies": model.nbody - 1,
        "joints": model.njnt,
        "mass_kg": model.body_mass.sum(),
    }
    assert numbers.items() <= result["sizes"].items()
    assert result["sizes"]["joints"] == 1


O_OBJ = Path("../../other/o.obj")
OUTSIDE = {
    "mesh folder": {"mjcf/m.xml": mjcf("o.obj", '<compiler meshdir="../../other"/>')},
    "texture folder": {
        "mjcf/m.xml": mjcf("o.obj", '<compiler texturedir="../../other"/>')
    },
    "mesh file": {"mjcf/m.xml": mjcf("../../other/o.obj")},
    "backslashes": {"mjcf/m.xml": mjcf("..\\..\\other\\o.obj")},
    "backslashes in a folder": {
        "mjcf/m.xml": mjcf("o.obj", '<compiler meshdir="..\\..\\other"/>')
    },
    "folder and file": {
        "mjcf/m.xml": mjcf("../../other/o.obj", '<compiler meshdir="../mjcf"/>')
    },
    "absolute": {"mjcf/m.xml": mjcf("PACKAGE/../other/o.obj")},
    "link": {"mjcf/m.xml": mjcf("l.obj"), "mjcf/l.obj": O_OBJ},
    "linked folder": {"mjcf/m.xml": mjcf("../d/o.obj"), "d": Path("../other")},
    "link by file name": {
        "mjcf/m.urdf": urdf("package://p/l.obj", STRIP),
        "meshes/l.obj": O_OBJ,
    },
    "include": {"mjcf/m.xml": '<mujoco><include file="../../other/o.xml"/></mujoco>'},
    "include, linked": {
        "mjcf/m.xml": '<mujoco><include file="l.xml"/></mujoco>',
        "mjcf/l.xml": Path("../../other/o.xml"),
    },
    "next to an include": {
        "mjcf/m.xml": '<mujoco><include file="../a/p.xml"/></mujoco>',
        "a/p.xml": '<mujoco><include file="../../other/o.xml"/></mujoco>',
    },
    "asset next to an include": {
        "mjcf/m.xml": '<mujoco><include file="../a/p.xml"/></mujoco>',
        "a/p.xml": mjcf("l.obj"),
        "a/l.obj": O_OBJ,
    },
    "attached, its own mesh folder": {
        "mjcf/m.xml": ATTACH.replace("../parts/p.xml", "../p.xml"),
        "p.xml": mjcf("o.obj", '<compiler meshdir="../other"/>'),
    },
    "attached": {"mjcf/m.xml": ATTACH.replace("../parts", "../../other")},
}


@pytest.mark.parametrize("name", OUTSIDE)
def test_files_outside_the_parent_folder_are_rejected_unread(name, tmp_path, srs_twin):
    laid_out(
        tmp_path / "other",
        {
            "o.obj": f"{SECRET}\n{TETRAHEDRON}",
            "o.xml": f"<{SECRET}/>",
            "p.xml": f"<{SECRET}/>",
        },
    )
    path = laid_out(tmp_path / "pkg", OUTSIDE[name])
    (fault,) = scan_mjcf(path)
    assert (
        f", outside the model's folder; files in {tmp_path / 'pkg'} are allowed"
        in fault
    ), fault
    done = srs_twin("models", "check", str(path), cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert SECRET not in done.stderr


def test_a_folder_directly_under_the_root_or_home_gives_no_access_to_its_parent(
    tmp_path, monkeypatch
):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    path = laid_out(
        tmp_path / "home", {"m.xml": mjcf("../t.obj"), "../t.obj": TETRAHEDRON}
    )
    (fault,) = scan_mjcf(path)
    assert fault.endswith(
        f"names '../t.obj', outside the model's folder; files in {tmp_path / 'home'}"
        " are allowed"
    )
    assert checks._allowed_folder(Path("/srv/m.xml")) == Path("/srv")
    assert checks._allowed_folder(Path("/srv/robot/m.xml")) == Path("/srv")
    assert checks._allowed_folder(Path("/m.xml")) == Path("/")


def included(file):
    return f'<mujoco><include file="{file}"/></mujoco>'


@pytest.mark.parametrize(
    ("files", "words"),
    [
        (
            {
                "a/m.xml": included("x0.xml"),
                **{f"a/x{i}.xml": included(f"x{i + 1}.xml") for i in range(2000)},
            },
            (
                "x29.xml:1: <include> names 'x30.xml'; files nested more than 30 deep"
                " are not allowed"
            ),
        ),
        (
            {"a/m.xml": included("d/m.xml"), "a/d": Path(".")},
            "names 'd/m.xml'; files nested more",
        ),
        (
            {"a/m.xml": ATTACH, "parts/p.xml": ATTACH},
            "names '../parts/p.xml', which is a part of itself",
        ),
        (
            {
                "a/m.xml": "".join(
                    [
                        "<mujoco>",
                        *(f"<compiler meshdir='{i}'/>" for i in range(20)),
                        "</mujoco>",
                    ]
                )
            },
            "line 1: more than 16 folders of assets",
        ),
        (
            {"a/m.xml": mjcf("../l.obj"), "l.obj": Path("l.obj")},
            "names '../l.obj', which is not a file",
        ),
        (
            {"a/m.xml": mjcf("../meshes"), **MESH},
            "line 1: <mesh> names '../meshes', which is not a file",
        ),
    ],
    ids=[
        "chain",
        "linked loop",
        "attached loop",
        "folders",
        "link to itself",
        "folder",
    ],
)
def test_circular_and_deep_references_are_rejected(files, words, tmp_path):
    (fault,) = scan_mjcf(laid_out(tmp_path, files))
    assert words in fault


def test_large_assets_are_rejected(tmp_path):
    path = laid_out(tmp_path, {"a/m.xml": mjcf("t.obj", UP), **MESH})
    os.truncate(tmp_path / "meshes/t.obj", 1 << 40)
    (fault,) = scan_mjcf(path)
    assert fault == "line 1: <mesh> names 't.obj', which brings the assets above 32 MB"


@pytest.mark.parametrize(
    "inside",
    [
        "",
        "<worldbody><geom size='.1'/></worldbody>",
        "<worldbody><body><geom size='.1'/></body></worldbody>",
    ],
)
def test_model_without_joints_is_a_fault(check, inside):
    report = check(inside)
    bodies = inside.count("<body>")
    assert report.faults == (
        (
            f"nothing in it moves ({bodies} bodies, no joints); it needs a body with a"
            " joint"
        ),
    )
    assert report.sizes["bodies"] == bodies


def test_welded_urdf_base_is_noted_with_a_remedy(tmp_path, srs_twin):
    laid_out(
        tmp_path,
        {
            "fixed.urdf": urdf(),
            "one.urdf": urdf(base=False),
            "dot.mjcf": f"<mujoco>{BALL}</mujoco>",
        },
    )
    done = srs_twin("models", "check", "fixed.urdf", "dot.mjcf", cwd=tmp_path)
    fit, base, ball = done.stdout.splitlines()
    assert fit.startswith("fixed.urdf: valid (1 bodies, 1 joints, 0 actuators, 0.4 kg")
    assert base.startswith(
        "fixed.urdf: its root link 'base' is welded to the world, as MuJoCo does"
    )
    assert (
        "for a free base, join it to a root link without mass by a joint of type"
        " floating" in base
    )
    assert (
        ball.startswith("dot.mjcf: valid (1 bodies, 1 joints") and done.returncode == 0
    )
    done = srs_twin("models", "check", "one.urdf", "--json", cwd=tmp_path)
    (actual,) = json.loads(done.stdout)["models"]
    assert done.returncode == 2 and len(actual["faults"]) == len(actual["notes"]) == 1
    assert "nothing in it moves (0 bodies, no joints)" in actual["faults"][0]
    assert actual["notes"][0] in actual["faults"][0]


def test_floating_urdf_base_has_no_note(tmp_path):
    free = (
        '<joint name="f" type="floating"><parent link="world"/><child'
        ' link="base"/></joint></robot>'
    )
    path = laid_out(
        tmp_path, {"m.urdf": urdf().replace("</robot>", f'<link name="world"/>{free}')}
    )
    values = examine_model(path, 30, 0.01)
    assert values["notes"] == values["faults"] == []
    assert (values["sizes"]["bodies"], values["sizes"]["mass_kg"]) == (
        2,
        pytest.approx(0.8),
    )


def test_package_uri_is_rejected_with_a_remedy(tmp_path):
    path = laid_out(
        tmp_path, {"urdf/m.urdf": urdf("package://pkg/meshes/t.obj"), **MESH}
    )
    (fault,) = examine_model(path, 30)["faults"]
    assert (
        "'package:/pkg/meshes/t.obj'; MuJoCo resolves no package:// or other URI; add"
        " <mujoco><" in fault
    )
    assert f"add <mujoco>{STRIP}</mujoco> to <robot>" in fault


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("robt.urdf", "robt.urdf: no such file; did you mean robot.urdf?"),
        (
            "robot",
            (
                "unknown robot or model file 'robot'; did you mean robot.urdf?"
                " (available: gen1, "
            ),
        ),
        (
            "gen22",
            (
                "unknown robot or model file 'gen22'; did you mean gen2? (available:"
                " gen1, "
            ),
        ),
        ("./robt.urdf", "robt.urdf: no such file; did you mean robot.urdf?"),
        (
            "nothing_alike",
            "unknown robot or model file 'nothing_alike' (available: gen1, ",
        ),
    ],
)
def test_unknown_model_name_raises_with_a_suggestion(name, said, tmp_path, srs_twin):
    laid_out(tmp_path, {"robot.urdf": urdf()})
    done = srs_twin("models", "check", name, cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.startswith(said), done.stderr
