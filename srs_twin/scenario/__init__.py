"""Scenarios: experiments that are read from files, checked, and built into plants and controllers."""

from srs_twin.scenario.expectation import Expectation
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.scenario.scenario import Scenario
from srs_twin.scenario.schema import scenario_json_schema

__all__ = ["Expectation", "Scenario", "load_scenario", "parse_scenario", "scenario_json_schema"]
