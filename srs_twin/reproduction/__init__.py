"""The dissertation's claims as rows: each one statement, the runs that produce it, and a verdict a plant."""

from srs_twin.reproduction.baseline import Baseline, load_baseline
from srs_twin.reproduction.claims import Claim, load_claims
from srs_twin.reproduction.evaluation import judge
from srs_twin.reproduction.execution import Store, open_store
from srs_twin.reproduction.outcomes import Judged, Outcome

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
