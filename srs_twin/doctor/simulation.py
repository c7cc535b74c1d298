"""What every run needs: the shipped data, numba's kernels, MuJoCo."""

from __future__ import annotations

from srs_twin.doctor.check import Check
from srs_twin.doctor.children import Answer

TOPIC = "simulation"
_REINSTALL = (
    "install srs-twin anew: `uv sync --reinstall` in a checkout, else `pip install --force-reinstall`"
)


def data_check(answer: Answer) -> Check:
    """Judge the robots, scenarios and models that come with the package."""
    said = answer.said
    if not answer.well:
        return _broken("shipped data", answer.complaint, _REINSTALL)
    counts = ", ".join(f"{said[kind]} {kind}" for kind in ("robots", "scenarios", "models"))
    where = f"{counts} in {said['root']}"
    if not (said["robots"] and said["scenarios"]):
        return Check(TOPIC, "shipped data", "missing", where, _REINSTALL, necessary=True)
    if said["bad"]:
        return _broken("shipped data", f"{where}; {'; '.join(said['bad'])}", _REINSTALL)
    return Check(TOPIC, "shipped data", "ok", f"{where}; all load", necessary=True)


def kernels_check(answer: Answer) -> Check:
    """Judge whether numba compiles and has a folder for what it compiled."""
    if answer.well and answer.said["agrees"]:
        detail = f"numba compiles, and keeps machine code in {answer.said['cache']}"
        return Check(TOPIC, "kernels", "ok", detail, necessary=True)
    if answer.well:
        return _broken("kernels", "numba's machine code computes other numbers than Python", _REINSTALL)
    if "no locator available" in answer.complaint:
        detail = "numba compiles, but finds no folder in which it may keep machine code"
        return _broken("kernels", detail, "export NUMBA_CACHE_DIR=/tmp/numba (any folder you may write)")
    return _broken("kernels", answer.complaint, "install numba and llvmlite anew: `uv sync --reinstall`")


def mujoco_check(answer: Answer) -> Check:
    """Judge whether MuJoCo compiles the shipped models and steps them."""
    if not answer.well:
        return _broken(
            "MuJoCo", answer.complaint, "install MuJoCo anew: `uv sync --reinstall-package mujoco`"
        )
    models = answer.said["models"]
    if answer.said["bad"]:
        remedy = "`srs-twin models check` says more; " + _REINSTALL
        return _broken("MuJoCo", "; ".join(answer.said["bad"]), remedy)
    if not models:
        return Check(TOPIC, "MuJoCo", "missing", "there is no model to try", _REINSTALL, necessary=True)
    detail = f"compiles {', '.join(models)}, and simulates 1 s of each without a warning"
    return Check(TOPIC, "MuJoCo", "ok", detail, necessary=True)


def _broken(name: str, detail: str, remedy: str) -> Check:
    return Check(TOPIC, name, "broken", detail, remedy, necessary=True)
