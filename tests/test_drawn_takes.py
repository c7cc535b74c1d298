"""Takes of all kinds: bodies lie within their stated errors, and no period of a gait is mistaken."""

from __future__ import annotations

import clocks
import numpy as np
import pytest
import takes

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(("noise", "most_refused"), [(2e-4, 0.02), (4e-4, 0.1)])
@pytest.mark.parametrize("plant", ["compliant", "twin"])
def test_bends_lie_within_their_stated_errors(noise, most_refused, plant):
    drawn = [takes.draw(seed, noise, plant) for seed in range(300, 330)]
    refused = [each for each in drawn if each.refused]
    assert len(refused) <= most_refused * len(drawn) + 1
    assert all(each.after for each in refused), [each.refused for each in refused]
    error, stated = (np.concatenate([getattr(each, name) for each in drawn]) for name in ("error", "stated"))
    assert 0.93 < (np.abs(error) < 1.96 * stated).mean() < 0.97


@pytest.mark.parametrize("spread", [0.0, 0.1])
def test_no_clock_is_off_by_a_period(spread):
    drawn = [clocks.draw(seed, spread) for seed in range(700, 730)]
    told = [each for each in drawn if each[0] in clocks.TOLD]
    errors = np.array([each[2] for each in told if not each[1]])
    assert len(errors) > 0.8 * len(told)
    assert (np.abs(errors) < (0.005 if spread == 0 else 0.02)).all()
    assert all(abs(each[2]) < 0.02 for each in drawn if not each[1])
