"""Finite differences of the speed in frequency and offset of a gait, and SciPy's methods on `rollout`.

uv run python benchmarks/scipy_steps.py

The reference of a derivative is the slope of a cubic fitted to 41 runs within ±0.1 Hz
or ±0.05 of the point. The complete model of gen2 runs 20 random gaits of 8 s with 0.8
to 2.6 Hz and offsets of 0.05 to 0.25.
"""

from __future__ import annotations

import numpy as np
from grid import table
from scipy import optimize

import srs_twin as srs

SECONDS = 8.0
WINDOW = {"frequency": 0.1, "offset": 0.05}
STEPS = (1e-8, 1e-6, 1e-4, 1e-3, 3e-3, 0.01, 0.02, 0.05)
PLANT = srs.AnalyticalSnake(srs.load_robot("gen2"), supply_pa=48.3e3)
START = (1.5, 0.1)


def speed(gait: np.ndarray) -> float:
    """Return the speed of a gait with a frequency (Hz) and an offset, m/s."""
    run = srs.rollout(PLANT, srs.Gait(*gait), SECONDS)
    return float(np.hypot(*(run.com[-1] - run.com[0])) / SECONDS)


def differences(gait: np.ndarray, axis: int, width: float) -> tuple[np.ndarray, float]:
    """Return the central differences at all steps, and the reference of the derivative."""
    direction = np.eye(2)[axis]
    shifts = np.linspace(-width, width, 41)
    values = [speed(gait + shift * direction) for shift in shifts]
    slope = np.polynomial.Polynomial.fit(shifts, values, 3).deriv()(0.0)
    pairs = [speed(gait + h * direction) - speed(gait - h * direction) for h in STEPS]
    return np.array(pairs) / (2 * np.array(STEPS)), float(slope)


def main() -> None:
    rng = np.random.default_rng(7)
    gaits = rng.uniform([0.8, 0.05], [2.6, 0.25], (20, 2))
    for axis, (name, width) in enumerate(WINDOW.items()):
        found = [differences(gait, axis, width) for gait in gaits]
        slopes = np.array([slope for _, slope in found])
        steps = np.array([each for each, _ in found])
        typical = np.median(np.abs(slopes))
        errors = np.abs(steps - slopes[:, None]) / typical
        rows = [
            [
                f"{h:g}",
                f"{(steps[:, k] == 0).sum()} of {len(gaits)}",
                f"{np.median(errors[:, k]):.2g}",
            ]
            for k, h in enumerate(STEPS)
        ]
        print(f"\n{name}: median derivative {typical:.2g}")
        print(table(["step", "exactly 0", "median error / median derivative"], rows))
    runs = 0

    def cost(gait: np.ndarray) -> float:
        nonlocal runs
        runs += 1
        return -speed(gait)

    bounds = [(0.5, 3.0), (-0.3, 0.3)]
    rows = []
    for method, options in (
        ("BFGS", {}),
        ("L-BFGS-B", {}),
        ("SLSQP", {}),
        ("L-BFGS-B", {"eps": 0.02}),
        ("Nelder-Mead", {"xatol": 1e-3, "fatol": 1e-4}),
        ("COBYQA", {"initial_tr_radius": 0.2, "final_tr_radius": 1e-3}),
    ):
        runs = 0
        box = None if method == "BFGS" else bounds
        result = optimize.minimize(
            cost, START, method=method, bounds=box, options=options
        )
        gait = ", ".join(f"{value:.3g}" for value in result.x)
        rows.append(
            [
                method,
                str(options),
                str(result.success),
                gait,
                f"{-result.fun:.4f}",
                str(runs),
            ]
        )
    print(
        table(
            ["method", "options", "success", "frequency, offset", "speed, m/s", "runs"],
            rows,
        )
    )


if __name__ == "__main__":
    main()
