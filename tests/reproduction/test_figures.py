"""The file of figures: what it names is there, and a bad one is refused in words."""

from __future__ import annotations

import re

import pytest

from srs_twin.errors import InputFileError
from srs_twin.reproduction.figures import load_pictures
from srs_twin.reproduction.runs import sweep_of

pytestmark = pytest.mark.fast


def test_sweeps_have_the_plots_that_figures_show():
    pictures = load_pictures()
    assert len(pictures) >= 50
    for picture in pictures:
        assert (picture.draw == "sweep") == (picture.metric is not None), picture.figure
        assert len(picture.names) in (0, len(picture.of))
        if picture.metric is not None:
            (runs,) = picture.of
            assert picture.metric in {plot.metric for plot in sweep_of(runs.name).plots}


FIGURE = "- {figure: '38', caption: Speed, draw: sweep, metric: com_speed_m_s, of: [{sweep: fig38}]}\n"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("draw: sweep", "draw: swep", "[0].draw: unknown picture 'swep'; did you mean sweep?"),
        ("fig38}", "fig3}", "[0].of[0].sweep: unknown sweep 'fig3'; did you mean"),
        ("{sweep: fig38}", "{law: turn_limt}", "unknown law 'turn_limt'; did you mean turn_limit?"),
        ("caption", "captoin", "unknown key; did you mean caption?"),
        (FIGURE, "{}\n", "must be a list of figures"),
    ],
)  # fmt: skip
def test_a_bad_file_is_refused_in_words(old, new, words, tmp_path):
    path = tmp_path / "figures.yaml"
    path.write_text(FIGURE)
    assert [load_picture.figure for load_picture in load_pictures(path)] == ["38"]
    path.write_text(FIGURE.replace(old, new, 1))
    with pytest.raises(InputFileError, match=re.escape(words)):
        load_pictures(path)
