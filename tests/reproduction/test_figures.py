"""File of figures: its sweeps have the plots, and invalid files are refused with a message."""

from __future__ import annotations

import re

import pytest

from srs_twin.errors import InputFileError
from srs_twin.reproduction.figures import load_figures
from srs_twin.reproduction.runs import sweep_of

pytestmark = pytest.mark.fast


def test_sweeps_have_the_plots_that_figures_show():
    figures = load_figures()
    assert len(figures) >= 50
    for figure in figures:
        assert (figure.draw == "sweep") == (figure.metric is not None), figure.figure
        assert len(figure.names) in (0, len(figure.of))
        if figure.metric is not None:
            (runs,) = figure.of
            assert figure.metric in {plot.metric for plot in sweep_of(runs.name).plots}


FIGURE = (
    "- {figure: '38', caption: Speed, draw: sweep, metric: com_speed_m_s, of: [{sweep:"
    " fig38}]}\n"
)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "draw: sweep",
            "draw: swep",
            "[0].draw: unknown picture 'swep'; did you mean sweep?",
        ),
        ("fig38}", "fig3}", "[0].of[0].sweep: unknown sweep 'fig3'; did you mean"),
        (
            "{sweep: fig38}",
            "{computation: turn_limt}",
            "unknown computation 'turn_limt'; did you mean turn_limit?",
        ),
        ("caption", "captoin", "unknown key; did you mean caption?"),
        (FIGURE, "{}\n", "must be a list of figures"),
    ],
)
def test_an_invalid_figures_file_is_refused_with_a_message(old, new, message, tmp_path):
    path = tmp_path / "figures.yaml"
    path.write_text(FIGURE)
    assert [entry.figure for entry in load_figures(path)] == ["38"]
    path.write_text(FIGURE.replace(old, new, 1))
    with pytest.raises(InputFileError, match=re.escape(message)):
        load_figures(path)
