"""Table of the studies: where each one is explained, its default size and its reduced size.

The title of a study is the first line of the docstring of its script. The default size
takes at most twelve minutes on two cores; the script has options for larger sizes.
"""

from __future__ import annotations

import ast
from dataclasses import dataclass
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parents[1]
OUT = "{out}"
"""Stands for an empty temporary folder in the arguments of a study."""


@dataclass(frozen=True)
class Study:
    """Study that `run.py` lists and runs.

    Attributes:
        minutes: estimated duration of the default size on two cores.
        page: page of docs/ that explains the result.
        arguments: arguments of the script for the default size.
        reduced: arguments for a reduced size, which `run.py --confirm` repeats; None if
            the default size is short enough.
        seeds: random seeds of the default size.
        group: dependency group that the script needs.
        inputs: patterns of further files that decide the result, relative to the
            checkout: those that the code does not name in full.
    """

    minutes: float
    page: str
    arguments: tuple[str, ...] = ()
    reduced: tuple[str, ...] | None = None
    seeds: str = "none"
    group: str = ""
    inputs: tuple[str, ...] = ()


def _words(text: str) -> tuple[str, ...]:
    return tuple(text.split())


STUDIES = {
    "against_drake": Study(10, "verification.md", group="drake"),
    "agreement": Study(3, "verification.md", reduced=_words("--quick")),
    "baselines": Study(
        10,
        "environments.md",
        _words("--first 0 --episodes 10"),
        _words("--first 0 --episodes 1 --tasks GoTo"),
        seeds="0 to 9",
    ),
    "clocks": Study(
        3,
        "recordings.md",
        _words("--seed 0 --draws 200"),
        _words("--seed 0 --draws 20"),
        seeds="0",
    ),
    "contact_estimate": Study(
        10,
        "objects.md",
        _words("--first 0 --robots 6 --free 60"),
        _words("--first 0 --robots 1 --free 10"),
        seeds="0 to 5",
    ),
    "damping": Study(
        10,
        "planar-models.md",
        _words("--spectra --material --steps --table"),
        _words("--spectra"),
    ),
    "environments": Study(3, "environments.md", seeds="0"),
    "fit_coverage": Study(
        12,
        "identification.md",
        _words(f"--first 0 --robots 6 --out {OUT}/fits.jsonl"),
        _words(f"--first 0 --robots 1 --only complete --out {OUT}/fits.jsonl"),
        seeds="0 to 5",
    ),
    "followed_worlds": Study(
        10,
        "course.md",
        _words("--first 0 --worlds 15"),
        _words("--first 0 --worlds 1 --robots gen2"),
        seeds="0 to 14",
    ),
    "following": Study(
        10,
        "course.md",
        _words("--seeds 5"),
        _words("--seeds 1 --plants analytical"),
        seeds="0 to 4",
    ),
    "frequency_response": Study(
        5,
        "module.md",
        _words(f"--results {OUT}"),
        seeds="of the sweeps",
        inputs=_words("scenarios/sweeps/fig44_*.yaml scenarios/module_*.yaml"),
    ),
    "gains": Study(5, "module.md", reduced=_words("--quick"), seeds="1"),
    "gpu": Study(
        10,
        "live-method.md",
        _words("--device cpu --seconds 1 --stepped 0.05 --worlds 1 16"),
    ),
    "grasp": Study(
        10,
        "objects.md",
        _words("--objects 10 --workers 2"),
        _words("--objects 1"),
        seeds="0 to 9",
    ),
    "intervals": Study(
        10, "identification.md", _words("100"), _words("2"), seeds="0 to 99"
    ),
    "learning": Study(
        12,
        "module.md",
        _words("--draws 15"),
        _words("--draws 2"),
        seeds="0 to 14",
    ),
    "live_estimates": Study(
        10, "live-method.md", _words("--seeds 2"), _words("--seeds 1"), seeds="1 to 2"
    ),
    "live_faults": Study(
        12,
        "live-method.md",
        _words("--first 6000 --seeds 2 --hours 0.1"),
        _words("--first 6000 --seeds 1 --hours 0 --condition nominal"),
        seeds="from 6000",
    ),
    "live_steering": Study(
        12, "live-method.md", _words("--seeds 1"), seeds="1 a fault"
    ),
    "module_table": Study(
        5,
        "module.md",
        _words("--draws 10"),
        _words("--leak --draws 2"),
        inputs=_words("scenarios/module_*.yaml"),
        seeds="0 to 9",
    ),
    "optimum": Study(
        12,
        "optimization.md",
        _words(
            f"--studies gen2_speed --seeds 3 --truth 100 --constrained 20 --out {OUT}"
        ),
        _words(
            "--studies gen2_speed --seeds 1 --truth 10 --constrained 1 --points 6"
            f" --out {OUT}"
        ),
        inputs=_words("scenarios/studies/gen2_speed.yaml scenarios/gen2_straight.yaml"),
        seeds="0 to 2, with a constraint 800 to 819",
    ),
    "planning": Study(
        8,
        "planning.md",
        _words("--draws 50 --worlds 100 --maps 1"),
        _words("--draws 2 --worlds 10 --maps 1"),
        seeds="0 to 49",
    ),
    "predict_others": Study(
        10,
        "reproduction.md",
        _words(f"--seed 0 --robots 20 --out {OUT}"),
        _words(f"--seed 0 --robots 4 --only onal_rus_2013 --out {OUT}"),
        inputs=_words("calibration/robots/others/*.yaml"),
        seeds="0",
    ),
    "predicted_rows": Study(
        12,
        "uncertainty.md",
        _words(f"--samples 8 --out {OUT}"),
        inputs=_words("scenarios/*.yaml"),
        seeds="0",
    ),
    "predictive": Study(
        12,
        "uncertainty.md",
        _words(f"--robots 20 --few 4 --out {OUT}"),
        _words(f"--robots 4 --few 2 --out {OUT}"),
        seeds="2",
    ),
    "presets": Study(12, "verification.md"),
    "scattering": Study(12, "friction.md", _words("--every 3"), _words("--fields 1")),
    "sensor": Study(0.2, "module.md"),
    "spatial": Study(8, "spatial.md", _words("--every 4"), _words("--quick")),
    "speed": Study(10, "verification.md", group="benchmarks"),
    "sweeps": Study(
        8,
        "sweeps.md",
        _words("--only engines twins --repetitions 1"),
        inputs=_words("scenarios/sweeps/fig31*.yaml"),
    ),
    "table8_fit": Study(
        10,
        "reproduction.md",
        _words("--plant analytical --threads 2"),
    ),
    "takes": Study(
        3,
        "recordings.md",
        _words("--seed 1000 --draws 200"),
        _words("--seed 1000 --draws 10"),
        seeds="1000",
    ),
    "theory": Study(
        6,
        "verification.md",
        _words("serpenoid connection rate amplitude hu"),
        _words("hu"),
    ),
    "transient": Study(3, "course.md"),
}


def script_of(name: str) -> Path:
    """Return the script of a study."""
    return BENCHMARKS / f"{name}.py"


def title_of(name: str) -> str:
    """Return the title of a study, without importing its script."""
    text = ast.get_docstring(ast.parse(script_of(name).read_text("utf-8"))) or ""
    return text.partition("\n")[0].rstrip(".")
