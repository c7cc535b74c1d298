"""What robot should be built, and how should it move: studies of designs and gaits over two fidelities."""

from __future__ import annotations

from srs_twin.studies.optimization.loading import load_study as load_study
from srs_twin.studies.optimization.search import Optimum as Optimum
from srs_twin.studies.optimization.search import search as search
