"""Scenarios: experiments that are read from files, checked, and built into plants and controllers."""

from srs_twin.extensions import lazy

__getattr__ = lazy(
    {
        "Expectation": "srs_twin.scenario.expectation:Expectation",
        "Scenario": "srs_twin.scenario.scenario:Scenario",
        "load_scenario": "srs_twin.scenario.loading:load_scenario",
        "parse_scenario": "srs_twin.scenario.loading:parse_scenario",
        "scenario_json_schema": "srs_twin.scenario.loading:scenario_json_schema",
    }
)
