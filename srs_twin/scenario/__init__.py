"""Scenario files: loading, validation and preparation of simulations."""

from typing import TYPE_CHECKING

from srs_twin.extensions import lazy

if TYPE_CHECKING:
    from srs_twin.scenario.expectation import Expectation as Expectation
    from srs_twin.scenario.loading import (
        load_scenario as load_scenario,
        parse_scenario as parse_scenario,
        scenario_json_schema as scenario_json_schema,
    )
    from srs_twin.scenario.scenario import Scenario as Scenario

lazy(__name__)
