"""Section `pegs` of a world, and the friction of obstacles."""

from __future__ import annotations

import numpy as np
import pytest

from srs_twin.errors import InputFileError
from srs_twin.scenario.loading import parse_scenario

PEGS = {"spacing_m": 0.13, "radius_m": 0.015, "rows": 4, "columns": 6, "x_m": -0.2}
PLANTS = {"analytical": {"model": "compliant", "contact": True}, "twin": {}}


def pegs(plants=PLANTS, start=None, obstacle_friction=None, **changes):
    return parse_scenario(
        {
            "robot": "gen2",
            "duration_s": 1,
            "seed": 3,
            "controller": {"kind": "gait", "frequency_hz": 1.0},
            "start": start or {},
            "world": {"pegs": PEGS | changes, "obstacle_friction": obstacle_friction},
            "plants": plants,
        },
    )


def grid(scenario):
    """Return x, y and radius of the pegs, shape (columns, rows, 3)."""
    posts = [(c.x, c.y, c.radius) for c in scenario.world.obstacles]
    return np.reshape(posts, (6, 4, 3))


def test_field_is_a_grid_about_the_line_of_the_start():
    posts = grid(pegs())
    assert posts[:, 0, 0] == pytest.approx(-0.2 + 0.13 * np.arange(6))
    assert posts[0, :, 1] == pytest.approx([-0.195, -0.065, 0.065, 0.195])
    assert (posts[..., 2] == 0.015).all()
    shift = grid(pegs(staggered=True, x_m=1.0))[..., 1] - posts[..., 1]
    assert shift[::2] == pytest.approx(0.13 / 4)
    assert shift[1::2] == pytest.approx(-0.13 / 4)


def test_seed_of_the_scenario_displaces_the_pegs():
    still = pegs()
    first = pegs(jitter_m=0.01)
    again = pegs(jitter_m=0.01)
    assert first.world.obstacles == again.world.obstacles
    other = pegs(jitter_m=0.01, seed=4)
    moves = np.abs(grid(first) - grid(still)).max(axis=(0, 1))
    assert (moves[:2] > 0.008).all() and (moves <= [0.01, 0.01, 0.0]).all()
    assert other.world.obstacles != first.world.obstacles


def test_field_is_ahead_of_the_start_by_default():
    posts = grid(pegs(x_m=None, start={"x_m": 1.0, "y_m": 0.5}))
    assert posts[0, :, 0] == pytest.approx(1.2)
    assert posts[..., 1].mean() == pytest.approx(0.5)


def test_plants_touch_pegs_with_the_stated_friction():
    scenario = pegs(obstacle_friction=0.2)
    assert scenario.world.friction == 0.2
    assert all(
        scenario.build_plant(kind).has_contact for kind in ("analytical", "twin")
    )
    assert pegs().world.friction == 0.5


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"jitter_m": 0.06}, "the spacing must be above 0.15 m"),
        ({"y_m": 0.065}, "overlaps the body at the start by"),
        ({"rows": 100, "columns": 11}, "1100 pegs are too many"),
        ({"plants": {"analytical": {}}}, "set `model: compliant` and `contact: true`"),
        (
            {"plants": {"analytical": {"contact": True}}},
            "touch obstacles, because its bends are prescribed; use model 'compliant'",
        ),
        ({"spacing": 0.1}, "did you mean spacing_m?"),
    ],
)
def test_bad_fields_are_refused(changes, words):
    with pytest.raises(InputFileError, match=words.replace("?", r"\?")):
        pegs(**changes)
