"""Refusals: inspect and replay name the format, the file and a remedy in the same message, exit code 2."""

from __future__ import annotations

import gzip
import io
import pickle
import re
import zipfile

import h5py
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from scipy.io import savemat

from srs_twin.cli import main


def hdf5(*names):
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        for name in names:
            file[name] = np.zeros((50, 3))
    return stream.getvalue()


def saved(save, *arguments, **named):
    stream = io.BytesIO()
    save(stream, *arguments, **named)
    return stream.getvalue()


def archive(name):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as file:
        file.writestr(name, "1,2,3")
    return stream.getvalue()


def parquet():
    table = pyarrow.table({"x": [1.0, 2.0]})
    stream = io.BytesIO()
    pyarrow.parquet.write_table(table, stream)
    return stream.getvalue()


REFUSED = {
    "dlc.h5": (
        lambda: hdf5("df_with_missing/table"),
        r"a DeepLabCut file \(HDF5\).*save_as_csv=True",
    ),
    "sleap.h5": (
        lambda: hdf5("tracks", "track_occupancy"),
        r"a SLEAP file \(HDF5\).*time,NAME_x,NAME_y",
    ),
    "other.h5": (lambda: hdf5("data"), "an HDF5 file.*time,NAME_x,NAME_y"),
    "a.npz": (
        lambda: saved(np.savez, points=np.zeros(9)),
        r"a NumPy archive \(.npz\).*numpy.savetxt",
    ),
    "packed.npz": (
        lambda: saved(np.savez_compressed, points=np.zeros(9)),
        r"a NumPy archive \(.npz\).*numpy.savetxt",
    ),
    "a.npy": (lambda: saved(np.save, np.zeros(9)), r"a NumPy array \(.npy\)"),
    "a.mat": (lambda: saved(savemat, {"x": np.zeros(9)}), "a MATLAB file.*writetable"),
    "a.xlsx": (lambda: archive("[Content_Types].xml"), r"an Excel workbook \(.xlsx\)"),
    "a.zip": (lambda: archive("take.csv"), "a ZIP archive cannot be read; unpack it"),
    "a.parquet": (parquet, "a Parquet file"),
    "a.pkl": (lambda: pickle.dumps({"x": 1}), "a Python pickle"),
    "a.bvh": (
        lambda: b"HIERARCHY\nROOT Hips\n",
        "a BVH file, .*, cannot be read; export CSV or C3D instead. Readable formats are"
        " C3D, MCAP",
    ),
    "a.tak": (lambda: b"\x01\x02\x03\0binary", "a take of Motive.*export it in Motive"),
    "a.csv.gz": (lambda: gzip.compress(b"time,x_1"), "a gzip archive"),
    "old.bag": (lambda: b"#ROSBAG V1.2\n" + bytes(99), "a bag of an older ROS"),
    "walk.db3.zstd": (lambda: b"\x28\xb5\x2f\xfd" + bytes(99), "a Zstandard archive"),
    "words.txt": (lambda: b"some,words\n1,2\n", "its first line is 'some,words'"),
    "noise.bin": (
        lambda: bytes(range(0xEF, 0x100)) * 30 + bytes(9),
        "a binary file of an unknown kind",
    ),
    "empty.c3d": (lambda: b"", "empty; a recording has"),
    "cut.mcap": (
        lambda: b"\x89MCAP0\r\n",
        "MCAP file is damaged|no topic with positions",
    ),
    "cut.bag": (lambda: b"#ROSBAG V2.0\nabc", "the ROS 1 bag file is damaged"),
    "cut.db3": (lambda: b"SQLite format 3\0abc", "the ROS 2 bag file is damaged"),
    "cut.trc": (lambda: b"PathFileType\t4\n", "the header is incomplete"),
    "cut.c3d": (
        lambda: b"\x02P" + bytes(600),
        "the C3D file is damaged|the C3D file has no points",
    ),
}


def said(words, capsys):
    with pytest.raises(SystemExit) as left:
        main(words)
    out = capsys.readouterr()
    assert left.value.code == 2 and "Traceback" not in out.err
    return out.err.strip()


@pytest.mark.default_cases(at=[0, 16, 20])
@pytest.mark.parametrize("name", REFUSED)
def test_inspect_and_replay_refuse_with_the_same_message(
    tmp_path, monkeypatch, capsys, name
):
    monkeypatch.chdir(tmp_path)
    make, words = REFUSED[name]
    (tmp_path / name).write_bytes(make())
    seen = said(["inspect", name], capsys)
    assert re.search(words, seen) and name in seen and len(seen.splitlines()) == 1
    assert said(["replay", name, "--robot", "gen2"], capsys) == seen


def test_a_missing_log_is_reported_for_a_valid_recording(
    tmp_path, monkeypatch, capsys, root
):
    monkeypatch.chdir(tmp_path)
    take = root / "calibration/examples/my_snake/walk_straight.csv"
    (tmp_path / "take.csv").write_bytes(take.read_bytes())
    assert "take.valves.csv: no such file" in said(
        ["replay", "take.csv", "--robot", "gen2"], capsys
    )


def test_errors_name_each_file(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("one.csv", "two.csv"):
        rows = "".join(f"{k / 100},{k},0.1,{k},0.2\n" for k in range(30))
        (tmp_path / name).write_text("time,a_x,a_y,b_x,b_y\n" + rows)
    (tmp_path / "map.yaml").write_text("markers:\n  c: {connector: 1}\n")
    lines = said(["inspect", "one.csv", "two.csv", "--map", "map.yaml"], capsys)
    assert re.search(r"one.csv: unknown marker 'c'", lines) and re.search(
        r"two.csv: unknown marker 'c'", lines
    )


def test_remedies_in_messages_are_options_or_keys_that_exist(root):
    """Text such as `give up=z` would not be an option of a command."""
    options = {
        "--up",
        "--layout",
        "--head",
        "--longest-gap",
        "--offset",
        "--units",
        "--rate",
    }
    for path in (root / "srs_twin/recordings").rglob("*.py"):
        for found in re.finditer(r"[;(?] ?[Gg]ive (\S+)", path.read_text("utf-8")):
            word = found[1].strip('"),;.')
            assert word in options or not re.fullmatch(r"\w+=\S*|\w+_\w+", word), (
                f"{path.name}: {found[0]}"
            )
