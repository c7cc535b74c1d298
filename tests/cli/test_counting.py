"""Progress of many runs: lines without a terminal, and the bar on a terminal."""

from __future__ import annotations

import io
import sys

import pytest

from srs_twin.cli import console
from srs_twin.cli.console import RunCounter
from srs_twin.identification.fitting import FitProgress

pytestmark = pytest.mark.fast


@pytest.fixture
def clock(monkeypatch):
    """A clock that a test turns."""

    class Clock:
        now = 100.0

        def monotonic(self):
            return self.now

    clock = Clock()
    monkeypatch.setattr(console, "time", clock)
    return clock


def terminal(monkeypatch):
    """Replace stderr by a text stream that pretends to be a terminal."""

    class Terminal(io.StringIO):
        def isatty(self):
            return True

    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    return stream


def test_progress_line_every_ten_seconds_has_rate_and_remaining_time(clock, capsys):
    with RunCounter("grid", 100) as done:
        for second in range(5, 55):
            clock.now = 100.0 + second
            done(failed=second == 20)
    lines = capsys.readouterr().err.splitlines()
    # The first run is done after 5 s, then one a second: workers take a while to start.
    assert lines == [
        "grid: 6 of 100, 1/s, 94 s left",
        "grid: 16 of 100, 1 failed, 1/s, 84 s left",
        "grid: 26 of 100, 1 failed, 1/s, 74 s left",
        "grid: 36 of 100, 1 failed, 1/s, 64 s left",
        "grid: 46 of 100, 1 failed, 1/s, 54 s left",
    ]


def test_a_search_tells_how_well_it_fits_every_ten_seconds(clock, capsys):
    with FitProgress("gen2_friction") as search:
        for runs in range(1, 24):
            clock.now += 1.0
            search(runs, 10.0 / runs)
    assert capsys.readouterr().err.splitlines() == [
        "gen2_friction: 10 model runs, smallest weighted RMS 1",
        "gen2_friction: 20 model runs, smallest weighted RMS 0.5",
    ]


@pytest.mark.parametrize("options", [{"quiet": True}, {}])
def test_short_or_quiet_runs_print_no_progress(clock, capsys, options):
    with RunCounter("grid", 3, **options) as done:
        for _ in range(3):
            clock.now += 20.0 if options else 0.5
            done(failed=False)
    assert capsys.readouterr().err == ""


def test_a_terminal_shows_a_bar(clock, monkeypatch):
    shown = terminal(monkeypatch)
    monkeypatch.setenv("COLUMNS", "100")
    with RunCounter("grid", 4) as done:
        for _ in range(4):
            clock.now += 3.0
            done(failed=False)
    assert (
        "grid" in shown.getvalue()
        and "4/4" in shown.getvalue()
        and "0.333/s" in shown.getvalue()
    )


def test_a_bar_is_drawn_once_and_filled_by_the_fraction_done(clock, monkeypatch):
    terminal(monkeypatch)
    with RunCounter("grid", 8) as done:
        clock.now += 1.9
        done(failed=False)
        assert done._progress is None  # short tasks show no bar
        for _ in range(5):
            clock.now += 0.1
            done(failed=False)
        (bar,) = done._progress.tasks
        assert (bar.description, bar.percentage) == ("grid", 75.0)


def test_a_bar_of_unknown_length_has_no_percentage(clock, monkeypatch):
    terminal(monkeypatch)
    with FitProgress("fit") as search:
        clock.now += 3.0
        search(1, 0.5)
        (bar,) = search._progress.tasks
        assert bar.total is None
