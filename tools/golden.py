"""SHA-256 digests of all shipped results, to verify that a change of structure leaves them unchanged.

    uv run python tools/golden.py           # compare with golden.json; exit 1 if a digest differs
    uv run python tools/golden.py --write   # after an intended change; CHANGELOG.md gives the reason
    uv run python tools/golden.py --only plans --only fits
    uv run python tools/golden.py --only scenarios --scenario gen2_straight

Runs the commands as a user does, in an empty folder: every shipped scenario with its
plants (Parquet files, metrics.json without wall times and versions), a sweep, the
verdicts of `reproduce --quick`, a fit of each kind, and 50 plans. The digests are valid
for one processor target, which golden.json names: results on other targets differ in
the last digits (docs/sweeps.md).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import astuple
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import yaml

from srs_twin import plan
from srs_twin.scenario.provenance import arithmetic

sys.path.append(str(Path(__file__).parents[1] / "tests/helpers"))
from plan_worlds import drawn_problem

HERE = Path(__file__).parent
GOLDEN = HERE / "golden.json"
EXAMPLES = Path("calibration/examples/my_snake")
SWEEP = "fig31_coarse"
PLANS = 50
_WALL = ("wall_s", "realtime_factor", "versions")
_FIND = "actuator.tau_fill_s,actuator.tau_vent_s"
FITS = {
    "friction": "pulls.csv --validate {0}/pulls_check.csv --robot gen2",
    "actuator": (
        "steps.csv --validate {0}/steps_check.csv --robot gen2 --head snake:1a"
        f" --parameters {_FIND}"
    ),
    "locomotion": (
        "walk_straight.csv --validate {0}/walk_check.csv --robot gen2 --starts 1 "
        "--parameters geometry.rigid_gap_m,bending.stiffness_nm_per_rad"
    ),
}


def scenarios(folder: Path, *names: str) -> Iterator[tuple[str, str]]:
    """Yield the digests of runs: each trajectory file, and metrics.json without wall times."""
    out = folder / "runs"
    where = (
        out / names[0] if len(names) == 1 else out
    )  # a single scenario writes to the folder itself
    _run(
        "run",
        *(names or [str(HERE.parent / "scenarios")]),
        "--out",
        str(where),
        "--quiet",
    )
    for run in sorted(path for path in out.iterdir() if path.is_dir()):
        for path in sorted(run.glob("*.parquet")):
            yield f"{run.name}/{path.name}", _digest(path.read_bytes())
        metrics = json.loads((run / "metrics.json").read_text("utf-8"))
        yield f"{run.name}/metrics", _digest(_without(metrics, _WALL))


def sweep(folder: Path, *_: str) -> Iterator[tuple[str, str]]:
    """Yield the digest of a sweep's table without its keys, which depend on the source code."""
    _run("sweep", SWEEP, "--out", str(folder / "sweep"), "--quiet")
    rows = pq.read_table(folder / "sweep" / "results.parquet").to_pylist()
    yield (
        SWEEP,
        _digest(
            sorted(
                json.dumps(_without(row, ("key", *_WALL)), sort_keys=True)
                for row in rows
            )
        ),
    )


def reproduction(folder: Path, *_: str) -> Iterator[tuple[str, str]]:
    """Yield the digest of the quick verdicts and their values."""
    out = folder / "reproduce"
    _run("reproduce", "--quick", "--no-figures", "--out", str(out), "--quiet")
    rows = json.loads((out / "reproduce.json").read_text("utf-8"))["rows"]
    yield "quick", _digest([_without(row, _WALL) for row in rows])


def fits(folder: Path, *_: str) -> Iterator[tuple[str, str]]:
    """Yield the digest of the file that each kind of fit writes."""
    for kind, words in FITS.items():
        arguments = [
            str(EXAMPLES / words.split()[0]),
            *shlex.split(words.format(EXAMPLES))[1:],
        ]
        _run(
            "calibrate",
            kind,
            *arguments,
            "--name",
            kind,
            "--out",
            str(folder / f"{kind}.yaml"),
            cwd=HERE.parent,
        )
        fit = yaml.safe_load((folder / f"{kind}.yaml").read_text("utf-8"))
        yield kind, _digest(_without(fit, ("command", *_WALL)))


def plans(folder: Path, *_: str) -> Iterator[tuple[str, str]]:
    """Yield the digest of 50 plans in random worlds, including refusals."""
    result = []
    for seed in range(PLANS):
        answer = plan(drawn_problem(seed))
        result.append(
            [
                answer.outcome.name,
                repr([astuple(item) for item in answer.segments]),
                answer.expanded,
            ]
        )
    yield f"{PLANS} plans", _digest(result)


PARTS: dict[str, Callable[..., Iterator[tuple[str, str]]]] = {
    part.__name__: part for part in (plans, sweep, fits, reproduction, scenarios)
}


def main() -> int:
    """Compute digests; write them, or print the names of those that differ."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--write", action="store_true", help="write these digests to golden.json"
    )
    parser.add_argument(
        "--only",
        action="append",
        choices=PARTS,
        help="compute only this group (repeatable)",
    )
    parser.add_argument(
        "--scenario",
        action="append",
        default=[],
        help="run only this scenario (repeatable)",
    )
    options = parser.parse_args()
    if GOLDEN.is_file():
        golden = json.loads(GOLDEN.read_text("utf-8"))
    else:
        golden = {}
    result: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in options.only or PARTS:
            result |= {
                f"{name}/{key}": value
                for key, value in PARTS[name](Path(folder), *options.scenario)
            }
            print(f"{name}: done", file=sys.stderr, flush=True)
    if options.write:
        kept = golden.get("sha256", {}) | result
        text = json.dumps(
            {"arithmetic": arithmetic(), "sha256": kept}, indent=1, sort_keys=True
        )
        GOLDEN.write_text(text + "\n", "utf-8")
        return 0
    if golden["arithmetic"] != arithmetic():
        print(
            f"golden.json was computed with {golden['arithmetic']}, this machine uses"
            f" {arithmetic()}"
        )
        return 2
    wanted = {
        key: value
        for key, value in golden["sha256"].items()
        if key.split("/")[0] in (options.only or PARTS)
        and not (
            options.scenario
            and key.startswith("scenarios/")
            and key.split("/")[1] not in options.scenario
        )
    }
    moved = sorted(
        key
        for key in wanted.keys() | result.keys()
        if wanted.get(key) != result.get(key)
    )
    print(
        "\n".join(
            [
                *(f"differs: {key}" for key in moved),
                f"{len(wanted) - len(moved)} of {len(wanted)} unchanged",
            ]
        )
    )
    return int(bool(moved))


def _run(*words: str, cwd: Path | None = None) -> None:
    # Missed expectations are ignored: only the written files are compared.
    command = [sys.executable, "-c", "from srs_twin.cli import main; main()", *words]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):
        raise SystemExit(
            f"{shlex.join(words)}: exit {done.returncode}\n{done.stderr[-2000:]}"
        )


def _without(value: Any, keys: tuple[str, ...]) -> Any:
    """Return a JSON value without some keys at any depth, including keys that follow a plant's name.

    Sentences and paths become empty: their wording and the place of the checkout do not
    count.
    """
    if isinstance(value, str) and (" " in value or "/" in value):
        return ""
    if isinstance(value, dict):
        return {
            k: _without(item, keys)
            for k, item in value.items()
            if k.rpartition(".")[2] not in keys
        }
    if isinstance(value, list):
        return [_without(item, keys) for item in value]
    return value


def _digest(value: Any) -> str:
    if isinstance(value, bytes):
        data = value
    else:
        data = json.dumps(value, sort_keys=True).encode()
    return hashlib.sha256(data).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
