"""Reproduction of the dissertation: claims, the runs that they need, and a verdict for each plant."""

from srs_twin.reproduction.claims import Claim, load_claims
from srs_twin.reproduction.runs import RunStore, open_store
from srs_twin.reproduction.verdicts import Baseline, JudgedClaim, Outcome, judge, load_baseline

__all__ = [
    "Baseline",
    "Claim",
    "JudgedClaim",
    "Outcome",
    "RunStore",
    "judge",
    "load_baseline",
    "load_claims",
    "open_store",
]
