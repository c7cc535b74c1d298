"""Optimisation of robot designs and gaits with two fidelities, `compliant` and the twin."""

from __future__ import annotations

from srs_twin.studies.optimization.loading import load_study as load_study
from srs_twin.studies.optimization.search import Optimum as Optimum
from srs_twin.studies.optimization.search import search as search
