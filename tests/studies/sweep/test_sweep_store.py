"""Store of rows: atomic writes, one sweep per folder, full disks, kills and damaged files."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys

import pytest
from hypothesis import given, strategies as st

from srs_twin.errors import InputError
from srs_twin.io.provenance import Provenance
from srs_twin.studies.sweep.store import FILE, RowStore
from srs_twin.studies.sweep.task import DONE, FAILED, Row

pytestmark = pytest.mark.fast

ROWS = [
    Row(
        f"{k:064x}",
        DONE,
        {"twin.com_speed_m_s": k / 7, "twin.turning_radius_m": None},
        0.5,
    )
    for k in range(40)
]
numbers = st.none() | st.floats(allow_nan=False, allow_infinity=False)


@given(
    values=st.dictionaries(st.text(max_size=9), numbers, max_size=5),
    reason=st.none() | st.text(max_size=20),
)
def test_added_rows_are_read_back(tmp_path_factory, values, reason):
    folder = tmp_path_factory.mktemp("store")
    row = Row(
        "ab", FAILED if reason else DONE, values, 1 / 3, reason, 3 if reason else 0
    )
    with RowStore(folder) as store:
        store.add(row)
    with RowStore(folder) as store:
        assert list(store.rows()) == [row]


def test_a_row_with_an_equal_key_is_replaced(tmp_path):
    with RowStore(tmp_path) as store:
        store.add(Row("a", FAILED, reason="boom", exit_code=3))
        store.add(Row("b", DONE))
        assert store.keys(failed=True) == {"a", "b"} and store.keys(failed=False) == {
            "b"
        }
        store.add(Row("a", DONE, {"x": 1.0}))
        assert [row.status for row in store.rows()] == [DONE, DONE]
        store.retain(["a"])
        assert store.keys(failed=True) == {"a"}


def test_the_folder_is_locked(tmp_path):
    with RowStore(tmp_path) as first:
        first.add(ROWS[0])
        with pytest.raises(InputError, match="another sweep uses this folder"):
            RowStore(tmp_path)
    with RowStore(tmp_path) as store:
        assert list(store.rows()) == ROWS[:1]


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    "junk",
    [
        "",
        "{",
        "junk",
        "null",
        "3",
        "[]",
        "[" * 100_000,
        "{}",
        b"\xff",
        4.5,
        '{"content": 1, "files": {}, "sources": {}, "versions": {}}',
        '{"content": {}, "files": [], "sources": {}, "versions": {}}',
        '{"content": {}, "files": {}, "sources": {"a": 1}, "versions": {}}',
        '{"content": {}, "files": {}, "sources": {}, "versions": 2}',
    ],
)
@pytest.mark.parametrize("table", ["about", "rows"])
def test_junk_is_refused_and_not_changed(tmp_path, junk, table):
    with RowStore(tmp_path) as store:
        store.claim(Provenance({}))
        store.add(ROWS[0])
    base = sqlite3.connect(tmp_path / FILE)
    with base:
        base.execute(
            f"UPDATE {table} SET {'value' if table == 'about' else 'row'} = ?", (junk,)
        )
    base.close()
    before = (tmp_path / FILE).read_bytes()
    with (
        RowStore(tmp_path) as store,
        pytest.raises(
            InputError,
            match="rows.sqlite: the file does not contain the rows of a sweep",
        ),
    ):
        store.claim(Provenance({})) if table == "about" else list(store.rows())
    assert (tmp_path / FILE).read_bytes() == before


def test_folders_of_a_store_without_rows_are_removed(tmp_path):
    with RowStore(tmp_path / "new/folder") as store:
        store.claim(Provenance({}))
    assert not list(tmp_path.iterdir())
    for row in ROWS[:2]:
        with RowStore(tmp_path / "new") as store:
            store.add(row)
    with RowStore(tmp_path / "new") as store:
        store.retain(())
    assert [path.name for path in tmp_path.rglob("*")] == ["new", FILE]


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("pages", range(8, 24))
def test_a_full_disk_keeps_the_earlier_rows(tmp_path, pages):
    """The database may not exceed a number of pages."""
    added = []
    with RowStore(tmp_path) as store:
        store.database.execute(f"PRAGMA max_page_count={pages}")
        with pytest.raises(
            InputError,
            match=(
                r"the file cannot be written \(database or disk is full\)\. Finished"
                r" rows are kept"
            ),
        ):
            for k in range(10_000):
                row = Row(f"{k:064x}", DONE, {"x": float(k)}, reason="long " * 20)
                store.add(row)
                added.append(row)
    assert added
    with RowStore(tmp_path) as store:
        assert list(store.rows()) == added
        store.add(Row("f" * 64, DONE))
        assert len(store.keys(failed=True)) == len(added) + 1


def test_kill_9_while_writing_loses_no_row(tmp_path):
    code = """
from pathlib import Path
from srs_twin.io.provenance import Provenance
from srs_twin.studies.sweep.store import RowStore
from srs_twin.studies.sweep.task import DONE, Row
with RowStore(Path(".")) as store:
    for k in range(10**9):
        store.add(Row(f"{k:064x}", DONE, {"x": float(k)}))
        print(k, flush=True)
"""
    with subprocess.Popen(
        [sys.executable, "-c", code], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    ) as writer:
        printed = [int(writer.stdout.readline()) for _ in range(7)]
        os.kill(writer.pid, signal.SIGKILL)
        printed += [int(line) for line in writer.stdout if line.endswith("\n")]
    with RowStore(tmp_path) as store:
        rows = list(store.rows())
    # All printed rows are stored, and at most one that was not printed.
    assert len(rows) - len(printed) in (0, 1)
    assert [(int(row.key, 16), row.values["x"]) for row in rows] == [
        (k, float(k)) for k in range(len(rows))
    ]


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    "content",
    [
        b"no rows at all",
        b"SQLite format 3\x00" + b"\xff" * 4000,
        b"SQLite format 3\x00",
        b"\x00" * 100,
    ],
    ids=["text", "damaged", "cut", "zeros"],
)
def test_other_files_are_refused_and_not_changed(tmp_path, content):
    (tmp_path / FILE).write_bytes(content)
    with pytest.raises(
        InputError, match=f"{FILE}: (the file does not contain the rows|cannot be used)"
    ):
        RowStore(tmp_path)
    assert (tmp_path / FILE).read_bytes() == content


@given(
    damage=st.lists(
        st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=20
    )
)
def test_a_damaged_file_is_read_or_refused(tmp_path_factory, damage):
    folder = tmp_path_factory.mktemp("damaged")
    with RowStore(folder) as store:
        for row in ROWS:
            store.add(row)
    content = bytearray((folder / FILE).read_bytes())
    for place, value in damage:
        content[int(place * (len(content) - 1))] = value
    (folder / FILE).write_bytes(content)
    try:
        with RowStore(folder) as store:
            for row in store.rows():
                assert isinstance(row, Row)
    except InputError as error:
        assert FILE in str(error)


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(
        InputError, match=r"file: the folder cannot be created \(File exists\)"
    ):
        RowStore(tmp_path / "file")
