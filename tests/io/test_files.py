"""Names and paths of files, YAML with positions, and atomic writes."""

from __future__ import annotations

import os
import re
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

from srs_twin.errors import InputError, InputFileError, UnknownNameError, WriteError
from srs_twin.io.documents import MAX_DEPTH, dump_yaml, parse_yaml
from srs_twin.io.files import (
    MAX_BYTES,
    atomic_write,
    check_output_folder,
    create_numbered_file,
    display_path,
    escape_unprintable,
    find_file,
    read_text,
    shipped_names,
)
from srs_twin.viewing.html import Table, render

pytestmark = pytest.mark.fast

ROBOTS = ["gen1", "gen2", "gen3", "gen4"]


def lines(text: str, name: str = "f.yaml") -> tuple[str, ...]:
    """Return the problems of YAML text."""
    with pytest.raises(InputFileError) as error:
        parse_yaml(text, name).raise_problems()
    return error.value.lines


def test_shipped_names_are_sorted():
    shipped = ["skin_example", "spatial_example", "spatial_slender"]
    assert shipped_names("robot") == [*ROBOTS, "gen4_module", *shipped]
    assert "gen2_straight" in shipped_names("scenario")


def test_shipped_file_is_found_from_any_folder(tmp_path, monkeypatch, root):
    monkeypatch.chdir(tmp_path)
    assert find_file("robot", "gen2") == root / "calibration/robots/gen2.yaml"


def test_text_with_slash_or_suffix_is_a_path(tmp_path, monkeypatch):
    (tmp_path / "gen2.yaml").write_text("")
    monkeypatch.chdir(tmp_path)
    assert find_file("robot", "gen2.yaml") == Path("gen2.yaml")
    assert find_file("robot", "./gen2.yaml") == Path("gen2.yaml")
    with pytest.raises(
        InputError, match=r"^x/gen2: no such file; did you mean gen2\?$"
    ):
        find_file("robot", "x/gen2")


def test_long_list_of_names_is_not_printed():
    with pytest.raises(UnknownNameError) as close:
        find_file("scenario", "gen2_strait")
    assert (
        str(close.value)
        == "unknown scenario 'gen2_strait'; did you mean gen2_straight?"
    )
    with pytest.raises(UnknownNameError) as far:
        find_file("scenario", "zzz")
    listed = (
        f"{len(shipped_names('scenario'))} names; `srs-twin list scenarios` lists them"
    )
    assert str(far.value) == f"unknown scenario 'zzz' (available: {listed})"


def test_existing_file_is_not_called_an_unknown_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.txt").write_text("title: x")
    (tmp_path / "empty").mkdir()
    with pytest.raises(
        InputError,
        match=r"^notes\.txt: the name of a scenario file must end in \.yaml or \.yml$",
    ):
        find_file("scenario", "notes.txt")
    with pytest.raises(
        InputError,
        match=r"^empty: this is a folder; give one file \(\.yaml; this folder contains none\)$",
    ):
        find_file("scenario", "empty")


def test_missing_file_has_a_suggestion(tmp_path):
    (tmp_path / "straight.yaml").write_text("")
    with pytest.raises(
        InputError, match=r"strait\.yaml: no such file; did you mean .*straight\.yaml\?"
    ):
        find_file("scenario", tmp_path / "strait.yaml")


def test_folder_is_rejected_with_an_example(tmp_path):
    (tmp_path / "straight.yaml").write_text("")
    with pytest.raises(
        InputError, match=r"a folder; give one file, such as .*straight\.yaml"
    ):
        find_file("scenario", f"{tmp_path}/")


@pytest.mark.parametrize(
    "name", ["a\0b.yaml", "x" * 5000 + ".yaml", "/dev/null/x.yaml", "a\0b", "x" * 5000]
)
def test_impossible_path_is_rejected(name):
    with pytest.raises(
        InputError, match=r"cannot be (read|used)|no such file|unknown scenario"
    ):
        find_file("scenario", name)


def test_pipe_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    with pytest.raises(InputError, match="not a regular file"):
        read_text(tmp_path / "pipe.yaml")


def test_text_that_is_not_utf8_is_rejected(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes("title: größe".encode("latin-1"))
    with pytest.raises(
        InputError,
        match=r"x\.yaml: the file is not UTF-8 text \(byte 10 is 0xf6\); save it as"
        r" UTF-8",
    ):
        read_text(path)


def test_byte_order_mark_is_removed(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\n")
    assert parse_yaml(read_text(path), "x").data == {"a": 1}


def test_file_size_is_limited(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes(b"#" * MAX_BYTES)
    assert len(read_text(path)) == MAX_BYTES
    path.write_bytes(b"#" * (MAX_BYTES + 1))
    with pytest.raises(InputError, match="larger than 64 kB"):
        read_text(path)
    os.truncate(path, (3 << 20) + 1)
    with pytest.raises(InputError, match="larger than 3 MB"):
        read_text(path, limit=3 << 20)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("yes", "yes"),
        ("true", True),
        ("012", 12),
        ("0x10", 16),
        ("0o17", 15),
        ("1_000", "1_000"),
        ("1e3", 1000.0),
        ("-.5", -0.5),
        (".inf", float("inf")),
        ("NaN", "NaN"),
        ("~", None),
        ("null", None),
        ("'1'", "1"),
        ("2020-01-01", "2020-01-01"),
        ("12:30", "12:30"),
        ("9" * 5000, float("inf")),
    ],
)
def test_scalars_follow_the_core_schema_of_yaml_1_2(text, value):
    assert parse_yaml(f"a: {text}\n", "x").data == {"a": value}


def test_positions_count_from_one():
    document = parse_yaml(
        "title: x\nlist:\n  - {a: 1, bc: [2, 3]}\nempty:\nlast: 1\n", "f.yaml"
    )
    assert document.values["title",] == (1, 8)
    assert document.keys["list", 0, "bc"] == (3, 12)
    assert document.values["list", 0, "bc", 1] == (3, 20)
    assert document.values["empty",] == (4, 1)


def test_all_rejected_features_are_reported_at_once():
    text = "a: &x 1\nb: *x\nc: !!str 2\na: 3\nd: {<<: {e: 1}}\n"
    assert lines(text) == (
        "f.yaml:1:4: anchors (&x) are not allowed; write each value out",
        "f.yaml:2:4: aliases (*x) are not allowed; write the value out",
        (
            "f.yaml:3:4: tags (tag:yaml.org,2002:str) are not allowed; write the plain"
            " value"
        ),
        "f.yaml:4:1: a: the key is given twice; the first one is on line 1",
        "f.yaml:5:5: merge keys (<<) are not allowed; write the keys out",
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "a: 1\n---\nb: 2\n",
            "f.yaml:2:1: a second YAML document begins here, but a file may have only one",
        ),
        ("%YAML 1.1\n---\na: 1\n", "f.yaml:1:1: YAML directives are not allowed"),
        ("a: 1\n\tb: 2\n", "f.yaml:2:1: not YAML: .*spaces, not tabs"),
        (
            "a: 'x\n",
            (
                "f.yaml:2:1: not YAML: while scanning a .* that begins on line 1: found"
                " unexpected end"
            ),
        ),
        ("a: b: c\n", "f.yaml:1:5: not YAML: mapping values are not allowed here"),
        ("a: 1\nb: \x00\n", r"f\.yaml:2:4: not YAML: the character U\+0000"),
        (
            'a: "\\UFFFFFFFF"\n',
            r"f.yaml:1:\d: not YAML: Python int too large|f.yaml:1:\d: not YAML: chr",
        ),
        (
            'a: "x\\e[31m"\n',
            r"f.yaml:1:4: the control character \\x1b is not allowed in text",
        ),
        (
            '"b\\nc": 1\n',
            r"f.yaml:1:1: the control character \\n is not allowed in text",
        ),
        ('a: "\\ud800"\n', "f.yaml:1:4: half a surrogate pair is not allowed"),
        ("? [1]\n: 2\n", "f.yaml:1:3: a key must be plain text"),
        (
            "[" * (MAX_DEPTH + 1),
            f"f.yaml:1:17: the file is nested more than {MAX_DEPTH} levels deep",
        ),
        (
            "[" + "1," * 10_000 + "1]",
            "f.yaml:1:20000: the file has more than 10000 keys and values",
        ),
    ],
)
def test_syntax_error_is_reported_with_its_position(text, message):
    (line,) = lines(text)
    assert re.search(message, line), line


def test_text_may_have_several_lines():
    document = parse_yaml('a: |\n  one\n  \ttwo\nb: "three\\n\\tfour"\n', "x")
    document.raise_problems()
    assert document.data == {"a": "one\n\ttwo\n", "b": "three\n\tfour"}


@given(st.text(st.characters()), st.sampled_from(["", "\n\t"]))
def test_no_control_character_is_printed(text, keep):
    escaped = escape_unprintable(text, keep=keep)
    assert not any(
        unicodedata.category(c) in ("Cc", "Cs") and c not in keep for c in escaped
    )
    assert escape_unprintable(escaped, keep=keep) == escaped
    clean = all(unicodedata.category(c) not in ("Cc", "Cs") or c in keep for c in text)
    assert (escaped == text) == clean


def test_path_is_displayed_with_escapes():
    assert (
        display_path(Path(os.fsdecode(b"runs/\xff\x1b[31m\n")))
        == r"runs/\xff\x1b[31m\n"
    )


def test_html_page_contains_no_control_characters():
    content = {
        "changes": ["b\x9b1m\nc"],
        "sections": {},
        "figures": [],
        "versions": Table((), ()),
    }
    text = render(
        "reproduction/report.html", title="a\x1b[31m", subtitle="<d\x07>", **content
    )
    assert r"<title>a\x1b[31m</title>" in text
    assert r'<p class="sub">&lt;d\x07&gt;</p>' in text and "<p>b\\x9b1m\nc</p>" in text


def test_nested_aliases_are_not_expanded():
    text = "a: &a [x, x]\n" + "".join(
        f"{b}: &{b} [*{a}, *{a}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
    )
    assert len(lines(text)) == 9 + 16


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**18), 10**18)
    | st.floats(allow_nan=False)
    | st.text(
        st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=40
    ),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.text("abc_1:# ", max_size=8), inner, max_size=4)
    ),
    max_leaves=12,
)


@given(plain)
def test_dumped_data_is_read_back_unchanged(data):
    document = parse_yaml(dump_yaml({"data": data}), "x")
    document.raise_problems()
    assert document.data == {"data": data}


@pytest.mark.parametrize(
    "text", ["yes", "012", "0x1F", "1e3", "5.", ".inf", "~", "12:30", "=", "<<"]
)
def test_text_that_looks_like_another_type_stays_text(text):
    for data in (text, {text: text}, [text]):
        assert parse_yaml(dump_yaml({"data": data}), "x").data == {"data": data}


def test_atomic_write_is_complete_or_keeps_the_old_file(tmp_path):
    target = tmp_path / "new" / "out.json"
    with atomic_write(target) as temporary:
        temporary.write_text("one")
        assert temporary.suffix == ".json" and not target.exists()
    assert target.read_text() == "one"
    with pytest.raises(KeyboardInterrupt), atomic_write(target) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert target.read_text() == "one"
    assert os.listdir(target.parent) == ["out.json"]


def test_atomic_write_to_an_unusable_path_is_rejected(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    for target in (tmp_path / "file" / "out.txt", tmp_path / "folder"):
        with (
            pytest.raises(InputError, match=r": the file cannot be written \("),
            atomic_write(target) as temporary,
        ):
            temporary.write_text("x")
    assert sorted(os.listdir(tmp_path)) == ["file", "folder"]


def test_failed_atomic_write_removes_its_folders(tmp_path):
    (tmp_path / "old").mkdir()
    for folder in ("new/er", "old/new", "x" * 400, f"new/{'x' * 400}"):
        with (
            pytest.raises(InputError),
            atomic_write(tmp_path / folder / "x" / ("y" * 400)) as temporary,
        ):
            temporary.write_text("x")
        assert os.listdir(tmp_path) == ["old"] and not os.listdir(tmp_path / "old")


@pytest.mark.parametrize("name", ["metrics", "sweep", "study"])
def test_a_folder_without_marks_may_contain_any_results(tmp_path, name):
    (tmp_path / "study.json").touch()
    check_output_folder(tmp_path, (f"{name}.json",))


def test_a_numbered_file_that_cannot_be_written_is_a_write_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(WriteError, match=r": the file cannot be written \("):
        create_numbered_file(tmp_path / "file" / "inner", "journal-{}.mcap")
    with pytest.raises(InputError, match="file: this is not a folder, so no file can"):
        create_numbered_file(tmp_path / "file", "journal-{}.mcap")
