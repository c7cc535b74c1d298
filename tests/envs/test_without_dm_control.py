"""Without dm-control everything works but `srs_twin.envs.dm`, which says why and names the alternatives."""

from __future__ import annotations

import subprocess
import sys

import pytest

WITHOUT = """
import sys
sys.modules |= dict.fromkeys(("dm_control", "dm_env", "labmaze"))  # importing them fails
import gymnasium
from srs_twin import Gait, InputError, TwinSnake, load_robot, rollout
from srs_twin.scenario.provenance import versions
rollout(TwinSnake(load_robot("gen2")), Gait(2.0), 0.1)
gymnasium.make("srs_twin.envs:SRSTwin/GoTo-v0").reset(seed=0)
assert "dm-control" not in versions(), "it determines no result"
try:
    import srs_twin.envs.dm
except InputError as error:
    print(error)
"""


@pytest.mark.slow
@pytest.mark.fast
def test_only_the_dm_env_interface_needs_dm_control():
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    for words in (
        "labmaze has no wheel",
        "Python 3.13 and later",
        "Gymnasium",
        "pip install dm-control",
    ):
        assert words in done.stdout
