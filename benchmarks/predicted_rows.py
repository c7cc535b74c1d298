"""Published predictions and their intervals: E, u_num, u_input and u_D of ASME V&V 20, one row each.

    uv run python benchmarks/predicted_rows.py --out FOLDER [--samples 32] [--only
    ID]... [--table]

Runs the predictions of `srs-twin reproduce` for robots drawn from their priors, for the
nominal robots, and with half the time step. Parameters that were fitted to three rows
of Table 8 are drawn from that fit, and the module on its bench has the prior of
generation 4's actuator. Not included are plans and their following (minutes each),
orders, and bounds that the project defined. u_D is half the difference between the two
sides in Table 8, and 1 % elsewhere. An interrupted study continues when started again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from common.grid import table
from scipy.special import ndtri
from scipy.stats import qmc

from srs_twin.identification.fit_file import load_fit
from srs_twin.identification.priors import Priors
from srs_twin.reproduction.claims import Claim, load_claims
from srs_twin.reproduction.runs import open_store
from srs_twin.reproduction.verdicts import judge
from srs_twin.robot.file import RobotFile, load_robot_file
from srs_twin.scenario.expectation import interval_verdict

ROOT = Path(__file__).parents[1]
LEFT_OUT = (
    "follow-sim",
    "experiments",
    "gen1-grid",
    "gen1-shape-rms",
    "smc-6hz-amplitude.low",
    "ilc-",
)
PRINTED = 0.01
SIGNS = {"near": "", "below": "≤ ", "above": "≥ "}
DIMENSIONS = 16
AS_IT_STANDS = "stands"
HALF_STEP = "half"
Document = dict[str, Any]
Numbers = dict[tuple[str, str], float]


@cache
def fitted() -> dict[str, tuple[float, float]]:
    """Return value and standard error of the parameters that were fitted to Table 8."""
    result = load_fit(ROOT / "calibration/fits/gen4_table8_twin.yaml").parameters
    return {
        p.name: (p.value, p.standard_error or 0.0)
        for p in result
        if p.value is not None
    }


def in_robot(robot: Document, fractions: np.ndarray) -> Document:
    """Return the plain data of a robot whose parameters are at the given quantiles."""
    file = RobotFile.model_validate(robot)
    if all(record.uncertain is None for record in file.records().values()):
        known = load_robot_file("gen4").records()
        own = file.model_dump(mode="json", exclude_none=True)
        for key in ("tau_fill_s", "tau_vent_s", "bend_rad"):
            uncertain = known[f"actuator.{key}"].uncertain
            assert uncertain is not None
            own["actuator"][key]["uncertain"] = uncertain.model_dump(mode="json")
        file = RobotFile.model_validate(own)
    priors = Priors.from_robot(file)
    count = len(priors.parameters)
    values = dict(
        zip(priors.paths, priors.quantile(fractions[:count]).tolist(), strict=True)
    )
    for fraction, (path, (value, error)) in zip(
        fractions[count:], fitted().items(), strict=False
    ):
        section, key = path.split(".")
        if "calibration/fits" in str(
            robot["friction"]["mu_t"]["source"]
        ) and key in robot.get(section, {}):
            values[path] = value + error * float(ndtri(fraction))
    changed = dict(robot)
    for path, value in values.items():
        section, key = path.split(".")
        old = changed[section][key]
        if isinstance(old["value"], list):
            several = [value] * len(old["value"])
        else:
            several = value
        new = {name: item for name, item in old.items() if name != "uncertain"} | {
            "value": several
        }
        changed[section] = {**changed[section], key: new}
    return changed


def alteration(which: str | np.ndarray) -> Callable[[Document], Document] | None:
    """Return a function that changes the robots or the time step of scenarios; None for nominal runs."""
    if isinstance(which, np.ndarray):
        return lambda document: {
            **document,
            "robot": in_robot(document["robot"], which),
        }
    if which == AS_IT_STANDS:
        return None

    def halved(document: Document) -> Document:
        steps = {
            name: {**p, "timestep_s": p["timestep_s"] / 2}
            for name, p in document["plants"].items()
        }
        return {**document, "plants": steps}

    return halved


def numbers(
    claims: tuple[Claim, ...], folder: Path, which: str | np.ndarray
) -> Numbers:
    """Return the predictions by (row, plant)."""
    with open_store(folder, alteration(which)) as store:
        rows = judge(claims, store)
    return {
        (row.claim.id, k): item.value
        for row in rows
        for k, item in row.outcomes.items()
    }


def scatter(claim: Claim, every: Mapping[str, Claim]) -> float:
    """Return u_D of a row."""
    assert claim.value is not None
    head, _, place = claim.id.rpartition(".")
    other = every.get(f"{head}.{place.translate(str.maketrans('pm', 'mp'))}")
    if other is not None and other is not claim and head.endswith(("speed", "radius")):
        return abs(abs(claim.value) - abs(other.value or 0.0)) / 2
    return PRINTED * abs(claim.value)


def rows(
    claims: tuple[Claim, ...], result: Mapping[str, Numbers]
) -> Iterator[list[str]]:
    """Yield the rows of the table."""
    every = {claim.id: claim for claim in claims}
    for claim, plant in product(claims, ("analytical", "twin")):
        stands, half = (
            result[k].get((claim.id, plant), np.nan) for k in (AS_IT_STANDS, HALF_STEP)
        )
        drawn = np.array(
            [
                item.get((claim.id, plant), np.nan)
                for k, item in result.items()
                if k.isdigit()
            ]
        )
        drawn = drawn[~np.isnan(drawn)]
        if np.isnan(stands) or len(drawn) < 8:
            continue
        stated = claim.value or 0.0
        terms = {
            "u_num": 2 * abs(half - stands),
            "u_input": float(drawn.std(ddof=1)),
            "u_D": scatter(claim, every),
        }
        low, middle, high = np.quantile(drawn, (0.025, 0.5, 0.975))
        further = 1.96 * np.hypot(terms["u_num"], terms["u_D"])
        low = middle - np.hypot(middle - low, further)
        high = middle + np.hypot(high - middle, further)
        short = max(stated - high if claim.rule != "below" else 0.0, 0.0)
        over = max(low - stated if claim.rule != "above" else 0.0, 0.0)
        score = high - low + 40 * (short + over)
        cells = [stated, stands, stands - stated, *terms.values()]
        yield [
            f"`{claim.id}`",
            plant,
            f"{SIGNS[claim.rule]}{stated:.4g}",
            *(f"{v:.3g}" for v in cells[1:]),
            max(terms, key=terms.__getitem__),
            f"{low:.3g} to {high:.3g}",
            "no" if short + over else "yes",
            f"{(high - low) / abs(stated):.0%}" if stated else "–",
            f"{score:.3g}",
        ]


def stored_rows(files: Sequence[Path]) -> None:
    """Print published values and intervals of `srs-twin uncertainty --write`, one row per plant."""
    print(
        "| scenario | plant | published | value | E | u_num | u_input | u_D | 95 % |"
        " errors of the ends | verdict | width | score |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|---|")
    for path in files:
        document = json.loads(path.read_text("utf-8"))
        for plant, metrics in document["plants"].items():
            for name, row in metrics.items():
                stated = row["published"]
                if not stated or name != "com_speed_m_s":
                    continue
                low, high = row["interval_95"]
                score = high - low + 40 * max(low - stated, stated - high, 0.0)
                numbers = (
                    stated,
                    row["value"],
                    row["value"] - stated,
                    row["u_num"],
                    row["u_input"],
                    PRINTED * stated,
                )
                cells = [f"{1000 * number:.3g}" for number in numbers]
                errors = row["interval_95_error"]
                rest = (
                    f"{1000 * low:.1f} to {1000 * high:.1f}",
                    ", ".join(f"{1000 * error:.2g}" for error in errors),
                    interval_verdict(stated, (low, high), errors).value,
                    f"{1000 * np.subtract(high, low):.0f}",
                    f"{1000 * score:.0f}",
                )
                print(
                    "| "
                    + " | ".join([document["scenario"], plant, *cells, *rest])
                    + " |"
                )


def main() -> None:
    """Run the predictions, evaluate them and print the table."""
    words = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    words.add_argument("--out", type=Path, help="folder of the runs")
    words.add_argument("--samples", type=int, default=32)
    words.add_argument("--only", action="append", default=[])
    words.add_argument(
        "--table",
        action="store_true",
        help="print the table of the existing results without running",
    )
    words.add_argument(
        "--stored",
        nargs="*",
        type=Path,
        metavar="FILE",
        help="print the intervals in these files, or in calibration/intervals, instead",
    )
    options = words.parse_args()
    if options.stored is not None:
        stored_rows(options.stored or sorted(ROOT.glob("calibration/intervals/*.json")))
        return
    if options.out is None:
        words.error("--out is missing: give the folder of the runs")
    claims = tuple(
        claim.model_copy(update={"cause": []})
        for claim in load_claims()
        if claim.use == "holdout"
        and claim.rule in SIGNS
        and not claim.id.startswith(LEFT_OUT)
        and claim.id.startswith(tuple(options.only) or "")
    )
    fractions = qmc.Sobol(DIMENSIONS, rng=0).random_base2(
        max(options.samples - 1, 1).bit_length()
    )
    todo: dict[str, str | np.ndarray] = {
        item: item for item in (AS_IT_STANDS, HALF_STEP)
    }
    todo |= {str(k): item for k, item in enumerate(fractions[: options.samples])}
    result = {}
    for name, which in todo.items():
        if options.table and not (options.out / name).exists():
            continue
        result[name] = numbers(claims, options.out / name, which)
        print(f"{name}: {len(result[name])} numbers", file=sys.stderr, flush=True)
    head = [
        "row",
        "plant",
        "published",
        "value",
        "E",
        "u_num",
        "u_input",
        "u_D",
        "largest",
    ]
    lines = list(rows(claims, result))
    print(table([*head, "95 %", "consistent", "width", "score"], lines))
    for plant in ("analytical", "twin"):
        of_plant = [line for line in lines if line[1] == plant]
        print(
            f"\n{plant}: {sum(line[10] == 'yes' for line in of_plant)} of"
            f" {len(of_plant)} rows consistent"
        )


if __name__ == "__main__":
    main()
