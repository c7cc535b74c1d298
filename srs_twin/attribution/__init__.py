"""Why twin and analytical model differ: assumptions switched one at a time."""

from srs_twin.attribution.explain import explain

__all__ = ["explain"]
