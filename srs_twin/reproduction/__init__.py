"""The dissertation's claims as rows: each one statement, the runs that produce it, and a verdict a plant."""

from srs_twin.reproduction.claims import Claim, load_claims
from srs_twin.reproduction.runs import Store, open_store
from srs_twin.reproduction.verdicts import Baseline, Judged, Outcome, judge, load_baseline

__all__ = [
    "Baseline",
    "Claim",
    "Judged",
    "Outcome",
    "Store",
    "judge",
    "load_baseline",
    "load_claims",
    "open_store",
]
