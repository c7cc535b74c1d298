"""Names and paths, YAML with positions, whole files."""

from __future__ import annotations

import os
import re
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from srs_twin.errors import InputError, InputFileError, UnknownNameError
from srs_twin.io.documents import MAX_DEPTH, dump_yaml, parse_yaml
from srs_twin.io.files import (
    MAX_BYTES,
    atomic_write,
    find,
    printable,
    read_text,
    shipped_names,
    shown,
)
from srs_twin.viewing.html.page import Table, render

pytestmark = pytest.mark.fast

ROBOTS = ["gen1", "gen2", "gen3", "gen4"]


def lines(text: str, name: str = "f.yaml") -> tuple[str, ...]:
    """Return what is refused in YAML text."""
    with pytest.raises(InputFileError) as error:
        parse_yaml(text, name).finish()
    return error.value.lines


def test_shipped_names():
    assert shipped_names("robot") == [*ROBOTS, "gen4_module"]
    assert "gen2_straight" in shipped_names("scenario")


def test_a_name_is_looked_up_from_any_folder(tmp_path, monkeypatch, root):
    monkeypatch.chdir(tmp_path)
    assert find("robot", "gen2") == root / "calibration/robots/gen2.yaml"


def test_what_has_a_slash_or_a_suffix_is_a_path(tmp_path, monkeypatch):
    (tmp_path / "gen2.yaml").write_text("")
    monkeypatch.chdir(tmp_path)
    assert find("robot", "gen2.yaml") == Path("gen2.yaml")
    assert find("robot", "./gen2.yaml") == Path("gen2.yaml")
    with pytest.raises(InputError, match=r"^x/gen2: no such file; did you mean gen2\?$"):
        find("robot", "x/gen2")


def test_an_unknown_name_says_what_was_meant():
    with pytest.raises(
        UnknownNameError, match=r"unknown robot 'gen22'; did you mean gen2\? \(available: gen1, "
    ):
        find("robot", "gen22")


def test_a_long_list_of_names_is_never_said():
    with pytest.raises(UnknownNameError) as close:
        find("scenario", "gen2_strait")
    assert str(close.value) == "unknown scenario 'gen2_strait'; did you mean gen2_straight?"
    with pytest.raises(UnknownNameError) as far:
        find("scenario", "zzz")
    listed = f"{len(shipped_names('scenario'))} names; `srs-twin list scenarios` lists them"
    assert str(far.value) == f"unknown scenario 'zzz' (available: {listed})"


def test_what_is_there_is_not_called_an_unknown_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.txt").write_text("title: x")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"^notes\.txt: a scenario file ends in \.yaml or \.yml$"):
        find("scenario", "notes.txt")
    with pytest.raises(InputError, match=r"^empty: a folder; give one file \(\.yaml; there is none in it\)$"):
        find("scenario", "empty")


def test_a_missing_file_says_which_one_was_meant(tmp_path):
    (tmp_path / "straight.yaml").write_text("")
    with pytest.raises(InputError, match=r"strait\.yaml: no such file; did you mean .*straight\.yaml\?"):
        find("scenario", tmp_path / "strait.yaml")


def test_a_folder_is_no_file(tmp_path):
    (tmp_path / "straight.yaml").write_text("")
    with pytest.raises(InputError, match=r"a folder; give one file, such as .*straight\.yaml"):
        find("scenario", f"{tmp_path}/")


@pytest.mark.parametrize("name", ["a\0b.yaml", "x" * 5000 + ".yaml", "/dev/null/x.yaml", "a\0b", "x" * 5000])
def test_impossible_paths(name):
    with pytest.raises(InputError, match=r"cannot be (read|used)|no such file|unknown scenario"):
        find("scenario", name)


def test_devices_and_pipes_are_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(InputError, match="not a regular file"):
        read_text(tmp_path / "pipe.yaml")


def test_text_that_is_not_utf8(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes("title: größe".encode("latin-1"))
    with pytest.raises(InputError, match=r"x\.yaml: not UTF-8 text \(byte 10 is 0xf6\); save it as UTF-8"):
        read_text(path)


def test_a_byte_order_mark_is_dropped(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\n")
    assert parse_yaml(read_text(path), "x").data == {"a": 1}


def test_size_is_bounded(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes(b"#" * MAX_BYTES)
    assert len(read_text(path)) == MAX_BYTES
    path.write_bytes(b"#" * (MAX_BYTES + 1))
    with pytest.raises(InputError, match="larger than 64 kB"):
        read_text(path)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("yes", "yes"), ("true", True), ("012", 12), ("0x10", 16), ("0o17", 15), ("1_000", "1_000"),
        ("1e3", 1000.0), ("-.5", -0.5), (".inf", float("inf")), ("NaN", "NaN"), ("~", None), ("null", None),
        ("'1'", "1"), ("2020-01-01", "2020-01-01"), ("12:30", "12:30"), ("9" * 5000, float("inf")),
    ],
)  # fmt: skip
def test_scalars_are_those_of_yaml_1_2(text, value):
    assert parse_yaml(f"a: {text}\n", "x").data == {"a": value}


def test_positions_count_from_one():
    document = parse_yaml("title: x\nlist:\n  - {a: 1, bc: [2, 3]}\nempty:\nlast: 1\n", "f.yaml")
    assert document.values["title",] == (1, 8)
    assert document.keys["list", 0, "bc"] == (3, 12)
    assert document.values["list", 0, "bc", 1] == (3, 20)
    assert document.values["empty",] == (4, 1)


def test_what_is_refused_comes_all_at_once():
    text = "a: &x 1\nb: *x\nc: !!str 2\na: 3\nd: {<<: {e: 1}}\n"
    assert lines(text) == (
        "f.yaml:1:4: anchors (&x) are not allowed; write each value out",
        "f.yaml:2:4: aliases (*x) are not allowed; write the value out",
        "f.yaml:3:4: tags (tag:yaml.org,2002:str) are not allowed; write the plain value",
        "f.yaml:4:1: a: given twice; the first is in line 1",
        "f.yaml:5:5: merge keys (<<) are not allowed; write the keys out",
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: 1\n---\nb: 2\n", "f.yaml:2:1: a second document begins here; one file holds one"),
        ("%YAML 1.1\n---\na: 1\n", "f.yaml:2:1: YAML directives are not allowed"),
        ("a: 1\n\tb: 2\n", "f.yaml:2:1: not YAML: .*spaces, not tabs"),
        ("a: 'x\n", "f.yaml:2:1: not YAML: while scanning a quoted scalar: found unexpected end"),
        ("a: b: c\n", "f.yaml:1:5: not YAML: mapping values are not allowed here"),
        ("a: 1\nb: \x00\n", r"f.yaml:2:4: not YAML: unusable character U\+0000"),
        ('a: "\\UFFFFFFFF"\n', r"f.yaml:1:\d: not YAML: Python int too large|f.yaml:1:\d: not YAML: chr"),
        ('a: "x\\e[31m"\n', r"f.yaml:1:4: the control character \\x1b is no character of a text"),
        ('a: "\\x9b1m"\n', r"f.yaml:1:4: the control character \\x9b is no character of a text"),
        ('a: "\\x7f"\n', r"f.yaml:1:4: the control character \\x7f is no character of a text"),
        ('a: "\\r"\n', r"f.yaml:1:4: the control character \\r is no character of a text"),
        ('"b\\e[0m": 1\n', r"f.yaml:1:1: the control character \\x1b is no character of a text"),
        ('"b\\nc": 1\n', r"f.yaml:1:1: the control character \\n is no character of a text"),
        ('a: "\\ud800"\n', "f.yaml:1:4: half a surrogate pair is no character"),
        ("? [1]\n: 2\n", "f.yaml:1:3: a key must be plain text"),
        ("[" * (MAX_DEPTH + 1), f"f.yaml:1:17: nested more than {MAX_DEPTH} deep"),
        ("[" + "1," * 10_000 + "1]", "f.yaml:1:20000: more than 10000 keys and values"),
    ],
)
def test_what_stops_the_parser(text, words):
    (line,) = lines(text)
    assert re.search(words, line), line


def test_values_may_have_several_lines():
    document = parse_yaml('a: |\n  one\n  \ttwo\nb: "three\\n\\tfour"\n', "x")
    document.finish()
    assert document.data == {"a": "one\n\ttwo\n", "b": "three\n\tfour"}


@given(st.text(st.characters()), st.sampled_from(["", "\n\t"]))
def test_nothing_that_a_terminal_obeys_is_printed(text, keep):
    said = printable(text, keep=keep)
    assert not any(unicodedata.category(c) in ("Cc", "Cs") and c not in keep for c in said)
    assert printable(said, keep=keep) == said
    clean = all(unicodedata.category(c) not in ("Cc", "Cs") or c in keep for c in text)
    assert (said == text) == clean


def test_names_are_shown_as_a_shell_could_write_them():
    assert shown(Path(os.fsdecode(b"runs/\xff\x1b[31m\n"))) == r"runs/\xff\x1b[31m\n"


def test_pages_hold_no_control_characters():
    content = {"changes": ["b\x9b1m\nc"], "sections": {}, "figures": [], "versions": Table((), ())}
    text = render("reproduction/report.html", title="a\x1b[31m", subtitle="<d\x07>", **content)
    assert r"<title>a\x1b[31m</title>" in text
    assert r'<p class="sub">&lt;d\x07&gt;</p>' in text and "<p>b\\x9b1m\nc</p>" in text


def test_an_alias_bomb_costs_nothing():
    text = "a: &a [x, x]\n" + "".join(
        f"{b}: &{b} [*{a}, *{a}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
    )
    assert len(lines(text)) == 9 + 16


plain = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**18), 10**18) | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=40),
    lambda inner: st.lists(inner, max_size=4)
    | st.dictionaries(st.text("abc_1:# ", max_size=8), inner, max_size=4),
    max_leaves=12,
)  # fmt: skip


@given(plain)
def test_what_is_dumped_is_read_back(data):
    document = parse_yaml(dump_yaml({"data": data}), "x")
    document.finish()
    assert document.data == {"data": data}


def test_atomic_write_leaves_the_whole_file_or_the_old_one(tmp_path):
    target = tmp_path / "new" / "out.json"
    with atomic_write(target) as part:
        part.write_text("one")
        assert part.suffix == ".json" and not target.exists()
    assert target.read_text() == "one"
    with pytest.raises(KeyboardInterrupt), atomic_write(target) as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert target.read_text() == "one"
    assert os.listdir(target.parent) == ["out.json"]


def test_atomic_write_says_where_it_cannot_write(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for target in (tmp_path / "file" / "out.txt", tmp_path / "folder"):
        with pytest.raises(InputError, match=r": cannot be written \("), atomic_write(target) as part:
            part.write_text("x")
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


def test_atomic_write_leaves_no_folder_behind_either(tmp_path):
    (tmp_path / "old").mkdir()
    for folder in ("new/er", "old/new", "x" * 400, f"new/{'x' * 400}"):
        with pytest.raises(InputError), atomic_write(tmp_path / folder / "x" / ("y" * 400)) as part:
            part.write_text("x")
        assert os.listdir(tmp_path) == ["old"] and not os.listdir(tmp_path / "old")
