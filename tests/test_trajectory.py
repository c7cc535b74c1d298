"""Trajectories: Parquet round trips, equal bytes, units, and rejected files."""

import io

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as npst
from processes import python
from synthetic import Snake

from srs_twin.errors import InputError
from srs_twin.io import untrusted
from srs_twin.trajectory import Event, Trajectory, UnknownColumnError

pytestmark = pytest.mark.fast

few = settings(deadline=None, max_examples=30)

json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False)
    | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=6,
)
events = st.builds(Event, st.floats(0, 1e6), st.text(max_size=9), st.text(max_size=9))
# Parquet names are UTF-8 text without lone surrogates.
names = st.text(
    st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=9
)


@st.composite
def trajectories(draw):
    columns = {"time": draw(st.integers(0, 6).map(lambda n: np.arange(n) / 100))}
    samples = len(columns["time"])
    for name in draw(st.lists(names, max_size=4, unique=True)):
        columns.setdefault(name, draw(npst.arrays(float, samples)))
    units = draw(
        st.dictionaries(st.sampled_from(list(columns)), st.text(max_size=4), max_size=2)
    )
    metadata = draw(st.dictionaries(st.text(max_size=9), json_values, max_size=3))
    return Trajectory(
        columns, units, tuple(draw(st.lists(events, max_size=3))), metadata
    )


def written(trajectory: Trajectory) -> bytes:
    file = io.BytesIO()
    trajectory.to_parquet(file)
    return file.getvalue()


def read(data: bytes) -> Trajectory:
    return Trajectory.from_parquet(io.BytesIO(data))


@few
@given(trajectories())
def test_written_trajectory_is_read_back_unchanged(original):
    result = read(written(original))
    assert list(result.columns) == list(original.columns)
    for name, column in original.columns.items():
        # Bit for bit: signed zeros and every NaN included.
        assert result[name].tobytes() == np.ascontiguousarray(column).tobytes(), name
        assert result.unit(name) == original.unit(name)
    assert result.events == original.events
    assert result.metadata == original.metadata


@few
@given(trajectories())
def test_rewritten_trajectory_has_the_same_bytes(original):
    once = written(original)
    assert written(original) == once
    assert written(read(once)) == once


def test_bytes_do_not_depend_on_the_order_of_metadata():
    columns = {"time": np.arange(3.0)}
    one = {"plant": "twin", "robot": "gen2"}
    other = {"robot": "gen2", "plant": "twin"}
    assert written(Trajectory(columns, metadata=one)) == written(
        Trajectory(columns, metadata=other)
    )


def test_columns_are_looked_up_by_name():
    run = Trajectory({"time": np.arange(3.0), "bend_1": np.zeros(3)})
    assert "bend_1" in run and "bend" not in run
    assert run.unit("bend_1") == run.unit("bend") == "rad"
    with pytest.raises(UnknownColumnError, match="unknown column 'bent_1'; did"):
        run.unit("bent_1")


def test_another_process_writes_the_same_bytes():
    program = (
        "import hashlib, io, numpy as np\n"
        "from srs_twin.trajectory import Event, Trajectory\n"
        "columns = {'time': np.arange(50) / 7, 'duty_1': np.sin(np.arange(50))}\n"
        "run = Trajectory(columns, {'duty_1': '%'}, (Event(0.5, 'contact', 'wall'),),"
        " {'plant': 'twin', 'seed': 3})\n"
        "file = io.BytesIO()\n"
        "run.to_parquet(file)\n"
        "print(hashlib.sha256(file.getvalue()).hexdigest())\n"
    )
    digests = {python("-c", program, PYTHONHASHSEED=seed).stdout for seed in ("1", "2")}
    assert len(digests) == 1


def test_any_parquet_reader_finds_the_units():
    schema = pq.read_schema(io.BytesIO(written(Snake().trajectory())))
    names = ("time", "com_x", "connector_heading_5", "bend_1")
    units = [schema.field(name).metadata[b"unit"] for name in names]
    assert units == [b"s", b"m", b"rad", b"rad"]


def test_numbered_columns_are_stacked():
    run = Snake(connectors=4).trajectory()
    assert run.stack("bend").shape == (len(run), 3)
    assert run.position.shape == (len(run), 4, 2)
    assert np.array_equal(run.position[:, 2, 1], run["y_3"])
    assert np.array_equal(run.com[:, 1], run["com_y"])
    assert run.has("bend") and run.has("com_x") and not run.has("pressure_plus")
    words = r"numbered columns 'bends'; did you mean bend\?"
    with pytest.raises(UnknownColumnError, match=words):
        run.stack("bends")


@pytest.mark.parametrize(("slack", "samples"), [(0.0, 11), (5e-10, 11), (2e-9, 9)])
def test_part_between_two_times_includes_both(slack, samples):
    run = Trajectory({"time": np.arange(31) / 100, "bend_1": np.arange(31.0)})
    part = run.between(0.1 + slack, 0.2 - slack)
    first = 10 if samples == 11 else 11
    assert part["bend_1"].tolist() == list(range(first, first + samples))


def test_columns_cannot_be_written():
    values = np.zeros(3)
    run = Trajectory({"time": np.arange(3.0), "bend_1": values})
    for column in (run["bend_1"], run.between(0.0, 1.0).time):
        with pytest.raises(ValueError, match="read-only"):
            column[0] = 1.0
    values[0] = 1.0  # the caller's own array stays writable


@pytest.mark.parametrize(
    ("name", "unit"),
    [("x_12", "m"), ("pressure_minus_2", "Pa"), ("offset", "rad"), ("duty", "1")],
)
def test_unit_follows_from_the_name_unless_given(name, unit):
    run = Trajectory({"time": np.zeros(1), name: np.zeros(1)}, {"offset": "rad"})
    assert run.unit(name) == unit


@few
@given(st.binary(max_size=200))
def test_random_bytes_are_rejected(data):
    with pytest.raises(InputError, match="not a trajectory written by srs-twin"):
        read(data)


@few
@given(st.data())
def test_damaged_trajectory_is_rejected_or_read(data):
    whole = written(Snake(duration=0.1, connectors=2).trajectory())
    damaged = bytearray(whole[: data.draw(st.integers(0, len(whole) - 1)) or None])
    damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(
        st.integers(1, 255)
    )
    try:
        assert "time" in read(bytes(damaged)).columns
    except InputError as error:
        assert "trajectory" in str(error)


METADATA = {"srs_twin.events": "[]", "srs_twin.metadata": "{}"}


@pytest.mark.parametrize(
    ("columns", "metadata", "message"),
    [
        (
            {"time": np.zeros(9), "text": ["x" * 999] * 9},
            METADATA,
            "column 'text' contains values of type string, but must contain float64",
        ),
        ({"time": np.zeros(9)}, {}, "the Parquet file has no metadata of srs-twin"),
    ],
)
def test_other_parquet_file_is_rejected_before_its_data_are_read(
    columns, metadata, message, tmp_path, monkeypatch
):
    """A kilobyte of text unpacks to a gigabyte."""
    pq.write_table(
        pa.table(columns).replace_schema_metadata(metadata), tmp_path / "a.parquet"
    )
    monkeypatch.setattr(untrusted, "_read", None)
    with pytest.raises(InputError, match=message):
        Trajectory.from_parquet(tmp_path / "a.parquet")


@pytest.mark.parametrize("key", [b"srs_twin.events", b"srs_twin.metadata"])
def test_file_with_two_different_schemas_is_rejected(key, tmp_path):
    """The footer contains the metadata twice, once in base64; damage can affect only one of them."""
    stream = io.BytesIO()
    Trajectory({"time": np.arange(3.0)}, {"time": "s"}).to_parquet(stream)
    whole = stream.getvalue()
    assert whole.count(key) == 1
    (tmp_path / "a.parquet").write_bytes(whole.replace(key, key.upper()))
    with pytest.raises(
        InputError, match="the Parquet file has no metadata of srs-twin"
    ):
        Trajectory.from_parquet(tmp_path / "a.parquet")
