"""MJCF files that would take hours, read files outside their folder, or diverge."""

# ruff: noqa: E501 - one malformed file per line, as a table
from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Any

from harness import Malformed
from hypothesis import strategies as st

FLOOR = '<geom type="plane" size="1 1 1"/>'
BODY = '<body pos="0 0 .2"><freejoint/><geom size=".1"/></body>'
BALL = f"<worldbody>{FLOOR}{BODY}</worldbody>"


def model(inside: str) -> bytes:
    """Return a model with all elements in the second line."""
    return f"<mujoco>\n{inside}\n</mujoco>".encode()


GOOD = model(
    '<option timestep="0.005" gravity="0 0 -9.81"/>\n<default><geom friction="1 .1'
    f' .1"/></default>\n<worldbody>{FLOOR}\n<body name="a" pos="0 0'
    ' .2"><freejoint/><geom size=".1"/>\n<body pos=".3 0 0"><joint name="j" axis="0 1'
    ' 0" damping=".1"/><geom type="capsule" size=".05'
    ' .1"/></body></body>\n</worldbody>\n<actuator><motor joint="j" ctrlrange="-1 1"'
    ' ctrllimited="true"/></actuator>'
)


def entities() -> bytes:
    """Return nested entities that expand to a billion words."""
    lines = [
        f'<!ENTITY a{k} "{10 * name}">'
        for k, name in enumerate(["lol", *(f"&a{k};" for k in range(9))])
    ]
    return f"<!DOCTYPE mujoco [{''.join(lines)}]>\n<mujoco model='&a9;'/>".encode()


def replicated(*counts: object) -> bytes:
    """Return a model with a site in nested replicates."""
    opened = "".join(f'<replicate count="{count}">' for count in counts)
    return model(
        f"<worldbody>{opened}<site/>{'</replicate>' * len(counts)}</worldbody>"
    )


def with_files(content: bytes, **files: Any) -> Any:
    """Return a function that writes a model and other files, given as bytes or as functions of a path."""

    def make(path: Path) -> None:
        path.write_bytes(content)
        for name, make_file in files.items():
            other = path.with_name(name.replace("__", "."))
            make_file(other) if callable(make_file) else other.write_bytes(make_file)

    return make


def with_own_name(inside: str) -> Any:
    """Return a function that writes a model; SELF is replaced by its file name."""
    return lambda path: path.write_bytes(model(inside.replace("SELF", path.name)))


def mesh(file: str) -> bytes:
    """Return a model with a mesh."""
    return model(f'<asset><mesh name="m" file="{file}"/></asset>{BALL}')


PICTURE = (
    b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
    + struct.pack(">II", 60_000, 60_000)
    + b"\x08\x02\0\0\0"
    + bytes(4)
)
STL = bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(100)
LETTER = "x"
LARGE = '<texture type="2d" builtin="flat" width="4096" height="4096"/>'

MALFORMED: tuple[Malformed, ...] = (
    Malformed("not XML", b"title: x\n", ": line 1: not readable as XML (syntax error)"),
    Malformed(
        "unclosed element",
        b"<mujoco>\n<worldbody>",
        ": line 2: not readable as XML (no element found)",
    ),
    Malformed(
        "crossed tags",
        b"<mujoco>\n<a><b></a></b></mujoco>",
        ": line 2: not readable as XML (mismatched tag)",
    ),
    Malformed(
        "two roots",
        b"<mujoco/>\n<mujoco/>",
        ": line 2: not readable as XML (junk after document element)",
    ),
    Malformed(
        "duplicate attribute",
        model('<option timestep="1" timestep="2"/>'),
        ": line 2: not readable as XML (duplicate attribute)",
    ),
    Malformed(
        "an unknown encoding",
        b'<?xml version="1.0" encoding="utf-9"?>\n<mujoco/>',
        ": line 1: not readable as XML (unknown encoding",
    ),
    Malformed(
        "UTF-16", GOOD.decode().encode("utf-16"), ": does not compile: XML parse error"
    ),
    Malformed(
        "NUL inside",
        model("<worldbody>\0</worldbody>"),
        ": line 2: not readable as XML",
    ),
    Malformed("HTML", b"<html><body><p>404</p></body></html>", ": does not compile"),
    Malformed(
        "SVG", b'<svg xmlns="http://www.w3.org/2000/svg"/>', ": does not compile"
    ),
    Malformed(
        "unknown element",
        model("<worldbody><bod/></worldbody>"),
        ": does not compile: XML Error: Schema violation",
    ),
    Malformed(
        "unknown attribute",
        model('<worldbody><body mas="1"/></worldbody>'),
        ": does not compile: XML Error: Schema violation",
    ),
    Malformed(
        "nested entities",
        entities(),
        ": line 1: a document type (<!DOCTYPE>) is not allowed",
    ),
    Malformed(
        "an external entity",
        b'<!DOCTYPE m [<!ENTITY x SYSTEM "file:///etc/passwd">]>\n<mujoco>&x;</mujoco>',
        ": line 1: a document type",
    ),
    Malformed(
        "a parameter entity",
        b'<!DOCTYPE m [<!ENTITY % x SYSTEM "http://127.0.0.1/x"> %x;]>\n<mujoco/>',
        ": line 1: a document type",
    ),
    Malformed(
        "a document type elsewhere",
        b'<!DOCTYPE mujoco SYSTEM "/dev/zero">\n<mujoco/>',
        ": line 1: a document type",
    ),
    Malformed(
        "a million copies",
        replicated(1000, 1000),
        ": line 2: more than 10000 elements, counting what is replicated",
    ),
    Malformed(
        "a trillion copies",
        replicated(10**4, 10**4, 10**4),
        ": line 2: more than 10000 elements",
    ),
    Malformed(
        "replicate count as a float",
        replicated("1e300"),
        ": line 2: more than 10000 elements",
    ),
    Malformed(
        "infinitely many copies",
        replicated("inf"),
        ": line 2: more than 10000 elements",
    ),
    Malformed(
        "2,000 bodies",
        model(f'<worldbody><replicate count="2000">{BODY}</replicate></worldbody>'),
        ": line 2: more than 1000 bodies",
    ),
    Malformed(
        "a cable of a million links",
        model(
            '<worldbody><body><composite type="cable" curve="s" count="1000000 1 1"'
            ' size="1"><geom type="capsule" size=".01"/></composite></body></worldbody>'
        ),
        ": line 2: more than 10000 elements",
    ),
    Malformed(
        "a jelly of 27 million points",
        model(
            '<worldbody><flexcomp name="f" type="grid" count="300 300 300"'
            ' dim="3"/></worldbody>'
        ),
        ": line 2: more than 10000 elements",
    ),
    Malformed(
        "100,000 bodies",
        model(f"<worldbody>{'<body/>' * 100_000}</worldbody>"),
        ": line 2: more than 1000 bodies",
    ),
    Malformed(
        "bodies 10,000 deep",
        model(f"<worldbody>{'<body>' * 10_000}{'</body>' * 10_000}</worldbody>"),
        ": line 2: nested more than 400 deep",
    ),
    Malformed(
        "a million elements deep",
        b"<a>" * 10**6 + b"</a>" * 10**6,
        ": over 4 MB of XML",
    ),
    Malformed(
        "5 MB of blanks",
        b"<mujoco>" + b" " * (5 << 20) + b"</mujoco>",
        ": over 4 MB of XML",
    ),
    Malformed(
        "100,000 keyframes",
        model(f"{BALL}<keyframe>{'<key/>' * 100_000}</keyframe>"),
        ": line 2: more than 10000 elements",
    ),
    Malformed(
        "100,000,000 keyframes",
        model(f'<size nkey="100000000"/>{BALL}'),
        ": line 2: <size> asks for nkey 100000000",
    ),
    Malformed(
        "900 GB of memory",
        model(f'<size memory="900G"/>{BALL}'),
        ": line 2: <size> asks for memory 900G",
    ),
    Malformed(
        "a billion numbers per body",
        model(f'<size nuser_body="1000000000"/>{BALL}'),
        ": line 2: <size> asks for nuser_body",
    ),
    Malformed(
        "2 billion contacts",
        model(f'<size nconmax="2000000000"/>{BALL}'),
        ": line 2: <size> asks for nconmax",
    ),
    Malformed(
        "a texture of 10 gigapixels",
        model(
            '<asset><texture type="2d" builtin="flat" width="100000"'
            f' height="100000"/></asset>{BALL}'
        ),
        ": line 2: more than 16777216 pixels",
    ),
    Malformed(
        "many large textures",
        model(f"<asset>{LARGE * 9}</asset>{BALL}"),
        ": line 2: more than 16777216 pixels",
    ),
    Malformed(
        "a height field of 10 gigapoints",
        model(
            '<asset><hfield name="h" nrow="100000" ncol="100000" size="1 1 1'
            f' 1"/></asset>{BALL}'
        ),
        ": line 2: more than 16777216 pixels of textures and points",
    ),
    Malformed(
        "include of a grandparent folder",
        model('<include file="../../other.xml"/>'),
        ": line 2: <include> names '../../other.xml', outside the model's folder",
    ),
    Malformed(
        "include of a password file",
        model('<include file="/etc/passwd"/>'),
        ": line 2: <include> names '/etc/passwd', outside the model's folder",
    ),
    Malformed(
        "include of a device",
        model('<include file="/dev/zero"/>'),
        ": line 2: <include> names '/dev/zero', outside the model's folder",
    ),
    Malformed(
        "include of a missing file",
        model('<include file="none.xml"/>'),
        ": line 2: <include> names 'none.xml', which is not a file",
    ),
    Malformed(
        "include of a pipe",
        with_files(model('<include file="pipe.xml"/>'), pipe__xml=os.mkfifo),
        ": line 2: <include> names 'pipe.xml', which is not a file",
    ),
    Malformed(
        "include through a link",
        with_files(
            model('<include file="l.xml"/>'),
            l__xml=lambda path: path.symlink_to("/etc/passwd"),
        ),
        ": line 2: <include> names 'l.xml', outside",
    ),
    Malformed(
        "include through a link to itself",
        with_files(
            model('<include file="l.xml"/>'),
            l__xml=lambda path: path.symlink_to("l.xml"),
        ),
        ": line 2: <include> names 'l.xml', which is not a file",
    ),
    Malformed(
        "include of itself",
        with_own_name('<include file="SELF"/>'),
        ": does not compile: XML Error: File",
    ),
    Malformed(
        "include in a circle",
        with_files(
            model('<include file="part_0.xml"/>'),
            part_0__xml=model('<include file="part_1.xml"/>'),
            part_1__xml=model('<include file="part_0.xml"/>'),
        ),
        ": does not compile: XML Error: File",
    ),
    Malformed(
        "include inside an include",
        with_files(
            model('<include file="part.xml"/>'),
            part__xml=model('<include file="/tmp/x.xml"/>'),
        ),
        ": part.xml:2: <include> names '/tmp/x.xml', outside the model's folder",
    ),
    Malformed(
        "copies in an include",
        with_files(model('<include file="part.xml"/>'), part__xml=replicated(10**6)),
        ": part.xml:2: more than 10000 elements",
    ),
    Malformed(
        "an include that is no XML",
        with_files(model('<include file="part.xml"/>'), part__xml=b"\xff\xfe\0"),
        ": part.xml:1: not readable as XML",
    ),
    Malformed(
        "a name of 5,000 characters",
        model(f'<include file="{5000 * LETTER}"/>'),
        ": line 2: <include> names ",
    ),
    Malformed(
        "mesh outside the folder",
        mesh("/etc/passwd"),
        ": line 2: <mesh> names '/etc/passwd', outside the model's folder",
    ),
    Malformed(
        "mesh in a parent folder",
        mesh("../../x.stl"),
        ": line 2: <mesh> names '../../x.stl', outside the model's folder",
    ),
    Malformed(
        "mesh folder outside the folder",
        model(f'<compiler meshdir="/etc"/>{BALL}'),
        ": line 2: <compiler> names '/etc', outside the model's folder",
    ),
    Malformed(
        "a mesh through a folder",
        with_files(
            model(f'<compiler meshdir="d"/><asset><mesh file="p.stl"/></asset>{BALL}'),
            d=lambda path: path.symlink_to("/etc"),
        ),
        ": line 2: <compiler> names 'd', outside",
    ),
    Malformed(
        "a mesh that is a pipe",
        with_files(mesh("p.stl"), p__stl=os.mkfifo),
        ": line 2: <mesh> names 'p.stl', which is not a file",
    ),
    Malformed(
        "a mesh that is a device",
        with_files(mesh("p.stl"), p__stl=lambda path: path.symlink_to("/dev/zero")),
        ": line 2: <mesh> names 'p.stl', outside",
    ),
    Malformed(
        "a mesh that is missing",
        mesh("none.stl"),
        ": does not compile: Error: Error opening file",
    ),
    Malformed(
        "a mesh of 4 billion faces",
        with_files(mesh("m.stl"), m__stl=STL),
        ": does not compile: Error: stl",
    ),
    Malformed(
        "a mesh of noise",
        with_files(mesh("m.obj"), m__obj=bytes(range(256))),
        ": does not compile: ",
    ),
    Malformed(
        "a mesh of 64 MB",
        with_files(
            mesh("m.stl"), m__stl=lambda path: path.write_bytes(bytes(64 << 20))
        ),
        ": line 2: <mesh> names 'm.stl', which brings the assets above 32 MB",
    ),
    Malformed(
        "a picture of 3.6 gigapixels",
        with_files(
            model(f'<asset><texture type="2d" file="p.png"/></asset>{BALL}'),
            p__png=PICTURE,
        ),
        ": line 2: <texture> names 'p.png', a picture of more than 16777216 pixels",
    ),
    Malformed(
        "a side of a cube elsewhere",
        model(f'<asset><texture type="cube" fileright="/etc/passwd"/></asset>{BALL}'),
        ": line 2: <texture> names '/etc/passwd', outside",
    ),
    Malformed(
        "a model that is a part of itself",
        with_own_name(
            '<asset><model name="x" file="SELF"/></asset><worldbody><attach model="x"'
            ' body="b" prefix="p"/></worldbody>'
        ),
        "which is a part of itself",
    ),
    Malformed(
        "models in models",
        with_files(
            model(
                '<asset><model name="x" file="part.xml"/></asset><worldbody>'
                + '<attach model="x" prefix="p"/>' * 100
                + "</worldbody>"
            ),
            part__xml=model(f"<worldbody>{'<site/>' * 900}</worldbody>"),
        ),
        "more than 10000 elements",
    ),
    Malformed(
        "an attached model elsewhere",
        model('<asset><model name="x" file="../../etc/passwd"/></asset>'),
        ": line 2: <model> names '../../etc/passwd', outside",
    ),
    Malformed(
        "negative friction",
        model(BALL.replace('size=".1"', 'size=".1" friction="-1 0 0"')),
        ": geom_friction[1] has a negative value",
    ),
    Malformed(
        "negative damping",
        model(
            '<worldbody><body><joint damping="-1"/><geom size=".1"/></body></worldbody>'
        ),
        ": dof_damping[0] has a negative value",
    ),
    Malformed(
        "negative mass",
        model(BALL.replace('size=".1"', 'size=".1" mass="-1"')),
        ": does not compile: Error: mass, inertia or density are negative",
    ),
    Malformed(
        "NaN for a time step",
        model(f'<option timestep="nan"/>{BALL}'),
        ": timestep nan s is not allowed; it must be 1e-05 to 0.1 s",
    ),
    Malformed(
        "a time step of a nanosecond",
        model(f'<option timestep="1e-9"/>{BALL}'),
        ": timestep 1e-09 s is not allowed",
    ),
    Malformed(
        "a time step of an hour",
        model(f'<option timestep="3600"/>{BALL}'),
        ": timestep 3600 s is not allowed",
    ),
    Malformed(
        "a negative time step",
        model(f'<option timestep="-0.001"/>{BALL}'),
        ": timestep -0.001 s is not allowed",
    ),
    Malformed(
        "a hundred million iterations",
        model(f'<option iterations="100000000"/>{BALL}'),
        ": iterations 100000000 are not allowed; at most 10000",
    ),
    Malformed(
        "position of NaN", model(BALL.replace("0 0 .2", "0 0 nan")), "not finite"
    ),
    Malformed(
        "position of 1e300 m",
        model(BALL.replace("0 0 .2", "1e300 0 0")),
        ": 1 s of random control raised the warning BADQPOS",
    ),
    Malformed(
        "gravity of NaN",
        model(f'<option gravity="nan 0 0"/>{BALL}'),
        ": 1 s of random control raised the warning BADQACC",
    ),
    Malformed(
        "friction of 1e300",
        model(BALL.replace('size=".1"', 'size=".1" friction="1e300 1 1"')),
        ": 1 s of random control raised the warning",
    ),
    Malformed(
        "strong motor on a light body",
        model(
            '<worldbody><body><joint name="j"/><geom size=".01"'
            ' mass="1e-6"/></body></worldbody><actuator><motor joint="j"'
            ' gear="1e12"/></actuator>'
        ),
        ": 1 s of random control raised the warning",
    ),
    Malformed(
        "too many joints",
        model(BALL.replace("<freejoint/>", "<freejoint/>" * 3)),
        ": does not compile: Error: ",
    ),
    Malformed(
        "no number",
        model(f'<option timestep="fast"/>{BALL}'),
        ": does not compile: XML Error: ",
    ),
)

_words = st.one_of(
    st.floats().map(repr),
    st.integers().map(str),
    st.text("0123456789.-e naif/", max_size=8),
    st.sampled_from(
        [
            "1e300",
            "nan",
            "inf",
            "0 0 0",
            "1 1 1 1 1 1 1",
            "2147483648",
            "../x",
            "/dev/zero",
            "true",
        ]
    ),
)
_tags = (
    "body",
    "geom",
    "joint",
    "freejoint",
    "site",
    "inertial",
    "replicate",
    "composite",
    "flexcomp",
    "frame",
    "camera",
    "light",
    "option",
    "size",
    "compiler",
    "default",
    "asset",
    "mesh",
    "hfield",
    "texture",
    "material",
    "include",
    "actuator",
    "motor",
    "position",
    "tendon",
    "sensor",
    "clock",
    "contact",
    "pair",
    "equality",
    "weld",
    "keyframe",
    "key",
    "worldbody",
    "attach",
    "model",
)
_names = (
    "name",
    "pos",
    "size",
    "type",
    "count",
    "mass",
    "quat",
    "axis",
    "range",
    "damping",
    "stiffness",
    "friction",
    "file",
    "timestep",
    "gravity",
    "nrow",
    "ncol",
    "width",
    "height",
    "builtin",
    "memory",
    "njmax",
    "joint",
    "gear",
    "ctrlrange",
    "solref",
    "solimp",
    "margin",
    "gap",
    "condim",
    "density",
    "meshdir",
    "iterations",
    "class",
    "offset",
)
_attributes = st.dictionaries(st.sampled_from(_names), _words, max_size=3).map(
    lambda drawn: "".join(f' {name}="{value}"' for name, value in drawn.items())
)
_elements = st.recursive(
    st.builds(
        lambda tag, attributes: f"<{tag}{attributes}/>",
        st.sampled_from(_tags),
        _attributes,
    ),
    lambda inner: st.builds(
        lambda tag, attributes, inner: f"<{tag}{attributes}>{''.join(inner)}</{tag}>",
        st.sampled_from(_tags),
        _attributes,
        st.lists(inner, max_size=3),
    ),
    max_leaves=5,
)
_in_body = st.sampled_from(
    ("pos", "size", "mass", "friction", "type", "margin", "solref", "condim", "density")
)
_bodies = st.dictionaries(_in_body, _words, max_size=3).map(
    lambda drawn: (
        "<worldbody>"
        + FLOOR
        + '<body pos="0 0 .2"><freejoint/><geom size=".1" '
        + "".join(
            f' {name}="{value}"' for name, value in drawn.items() if name != "size"
        )
        + "/></body></worldbody>"
    )
)
VALUES = st.one_of(
    st.lists(_elements, max_size=4).map(
        lambda elements: model("".join(elements) + BALL)
    ),
    st.lists(_elements, max_size=3).map(
        lambda elements: model(f"<worldbody>{''.join(elements)}</worldbody>")
    ),
    _bodies.map(model),
)
