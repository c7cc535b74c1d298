"""What every shipped result is, as SHA-256: a change of structure leaves all of them as they are.

    uv run python benchmarks/golden.py           # compares with golden.json; exit 1 where one differs
    uv run python benchmarks/golden.py --write   # after a change that is meant; CHANGELOG.md says why
    uv run python benchmarks/golden.py --only plans --only fits
    uv run python benchmarks/golden.py --only scenarios --scenario gen2_straight

Runs the commands as a user does, in an empty folder: every shipped scenario on the plants that it names
(Parquet files, metrics.json without wall times and versions), a sweep, the verdicts of `reproduce --quick`,
a fit of each kind and 50 plans. Holds on one processor target, which golden.json names: other targets differ
in last digits (docs/sweeps.md).
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
from ruamel.yaml import YAML

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
    "actuator": f"steps.csv --validate {{0}}/steps_check.csv --robot gen2 --head snake:1a --find {_FIND}",
    "locomotion": "walk_straight.csv --validate {0}/walk_check.csv --robot gen2 --starts 1 "
    "--find geometry.rigid_gap_m,bending.stiffness_nm_per_rad",
}


def scenarios(folder: Path, *names: str) -> Iterator[tuple[str, str]]:
    """Yield the digests of runs: each trajectory's file, and metrics.json without what the clock decides."""
    out = folder / "runs"
    where = out / names[0] if len(names) == 1 else out  # of one alone, the folder itself
    _run("run", *(names or [str(HERE.parent / "scenarios")]), "--out", str(where), "--quiet")
    for run in sorted(path for path in out.iterdir() if path.is_dir()):
        for path in sorted(run.glob("*.parquet")):
            yield f"{run.name}/{path.name}", _digest(path.read_bytes())
        metrics = json.loads((run / "metrics.json").read_text("utf-8"))
        yield f"{run.name}/metrics", _digest(_without(metrics, _WALL))


def sweep(folder: Path, *_: str) -> Iterator[tuple[str, str]]:
    """Yield the digest of a sweep's table without its keys, which cover the program's sources."""
    _run("sweep", SWEEP, "--out", str(folder / "sweep"), "--quiet")
    rows = pq.read_table(folder / "sweep" / "results.parquet").to_pylist()
    yield SWEEP, _digest(sorted(json.dumps(_without(row, ("key", *_WALL)), sort_keys=True) for row in rows))


def reproduction(folder: Path, *_: str) -> Iterator[tuple[str, str]]:
    """Yield the digest of the quick verdicts with their numbers."""
    out = folder / "reproduce"
    _run("reproduce", "--quick", "--no-figures", "--out", str(out), "--quiet")
    rows = json.loads((out / "reproduce.json").read_text("utf-8"))["rows"]
    yield "quick", _digest([_without(row, _WALL) for row in rows])


def fits(folder: Path, *_: str) -> Iterator[tuple[str, str]]:
    """Yield the digest of what each kind of fit wrote."""
    for kind, words in FITS.items():
        given = [str(EXAMPLES / words.split()[0]), *shlex.split(words.format(EXAMPLES))[1:]]
        _run(
            "calibrate", kind, *given, "--name", kind, "--out", str(folder / f"{kind}.yaml"), cwd=HERE.parent
        )
        yield kind, _digest(_without(YAML(typ="safe").load(folder / f"{kind}.yaml"), ("command", *_WALL)))


def plans(folder: Path, *_: str) -> Iterator[tuple[str, str]]:
    """Yield the digest of 50 plans in drawn worlds, refusals among them."""
    found = []
    for seed in range(PLANS):
        answer = plan(drawn_problem(seed))
        found.append(
            [answer.outcome.name, repr([astuple(each) for each in answer.segments]), answer.expanded]
        )
    yield f"{PLANS} plans", _digest(found)


PARTS: dict[str, Callable[..., Iterator[tuple[str, str]]]] = {
    part.__name__: part for part in (plans, sweep, fits, reproduction, scenarios)
}


def main() -> int:
    """Compute digests; write them, or name those that differ."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--write", action="store_true", help="keep these digests as the golden ones")
    parser.add_argument("--only", action="append", choices=PARTS, help="this part alone (repeatable)")
    parser.add_argument("--scenario", action="append", default=[], help="this one alone (repeatable)")
    given = parser.parse_args()
    golden = json.loads(GOLDEN.read_text("utf-8")) if GOLDEN.is_file() else {}
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in given.only or PARTS:
            found |= {f"{name}/{key}": value for key, value in PARTS[name](Path(folder), *given.scenario)}
            print(f"{name}: done", file=sys.stderr, flush=True)
    if given.write:
        kept = golden.get("sha256", {}) | found
        text = json.dumps({"arithmetic": arithmetic(), "sha256": kept}, indent=1, sort_keys=True)
        GOLDEN.write_text(text + "\n", "utf-8")
        return 0
    if golden["arithmetic"] != arithmetic():
        print(f"golden.json is of {golden['arithmetic']}, this machine computes with {arithmetic()}")
        return 2
    wanted = {
        key: value
        for key, value in golden["sha256"].items()
        if key.split("/")[0] in (given.only or PARTS)
        and not (given.scenario and key.startswith("scenarios/") and key.split("/")[1] not in given.scenario)
    }
    moved = sorted(key for key in wanted.keys() | found.keys() if wanted.get(key) != found.get(key))
    print(
        "\n".join(
            [
                *(f"differs: {key}" for key in moved),
                f"{len(wanted) - len(moved)} of {len(wanted)} as they were",
            ]
        )
    )
    return int(bool(moved))


def _run(*words: str, cwd: Path | None = None) -> None:
    # Expectations and verdicts decide nothing here: what matters is what was written.
    command = [sys.executable, "-c", "from srs_twin.cli import main; main()", *words]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
    if done.returncode not in (0, 1):
        raise SystemExit(f"{shlex.join(words)}: exit {done.returncode}\n{done.stderr[-2000:]}")


def _without(value: Any, keys: tuple[str, ...]) -> Any:
    """Return a JSON value without some keys, at any depth, behind the name of a plant too."""
    if isinstance(value, dict):
        return {k: _without(each, keys) for k, each in value.items() if k.rpartition(".")[2] not in keys}
    if isinstance(value, list):
        return [_without(each, keys) for each in value]
    return value


def _digest(value: Any) -> str:
    data = value if isinstance(value, bytes) else json.dumps(value, sort_keys=True).encode()
    return hashlib.sha256(data).hexdigest()


if __name__ == "__main__":
    sys.exit(main())
