"""Progress messages of many runs, with and without a terminal."""

from __future__ import annotations

import io
import sys

import pytest

from srs_twin.cli import progress
from srs_twin.cli.progress import Counting
from srs_twin.identification.fitting import Searching

pytestmark = pytest.mark.fast


@pytest.fixture
def clock(monkeypatch):
    """Clock that a test advances."""

    class Clock:
        now = 100.0

        def monotonic(self):
            return self.now

    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


def test_progress_line_every_ten_seconds_has_rate_and_remaining_time(clock, capsys):
    with Counting("grid", 100) as done:
        for second in range(5, 55):
            clock.now = 100.0 + second
            done(failed=second == 20)
    lines = capsys.readouterr().err.splitlines()
    # The first run ends after 5 s because workers start slowly, then one run ends per second.
    assert lines == [
        "grid: 6 of 100, 1/s, 94 s left",
        "grid: 16 of 100, 1 failed, 1/s, 84 s left",
        "grid: 26 of 100, 1 failed, 1/s, 74 s left",
        "grid: 36 of 100, 1 failed, 1/s, 64 s left",
        "grid: 46 of 100, 1 failed, 1/s, 54 s left",
    ]


def test_search_reports_its_misfit_every_ten_seconds(clock, capsys):
    with Searching("gen2_friction") as message:
        for runs in range(1, 24):
            clock.now += 1.0
            message(runs, 10.0 / runs)
    assert capsys.readouterr().err.splitlines() == [
        "gen2_friction: 10 runs of the model, weighted residuals 1 RMS at best",
        "gen2_friction: 20 runs of the model, weighted residuals 0.5 RMS at best",
    ]


@pytest.mark.parametrize("options", [{"quiet": True}, {}])
def test_brief_or_quiet_runs_print_nothing(clock, capsys, options):
    with Counting("grid", 3, **options) as done:
        for _ in range(3):
            clock.now += 20.0 if options else 0.5
            done(failed=False)
    assert capsys.readouterr().err == ""


def test_terminal_shows_a_progress_bar(clock, monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("COLUMNS", "100")
    with Counting("grid", 4) as done:
        for _ in range(4):
            clock.now += 3.0
            done(failed=False)
    assert "grid" in terminal.getvalue() and "4/4" in terminal.getvalue() and "0.333/s" in terminal.getvalue()
