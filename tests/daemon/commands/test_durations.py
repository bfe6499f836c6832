"""Durations on the command line: one way to write them, whatever the command."""

import pytest

from daemon.commands.durations import duration_s


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("90s", 90.0), ("10m", 600.0), ("5min", 300.0), ("1.5 h", 5400.0), ("2w", 1_209_600.0)],
)
def test_a_duration_is_read(text: str, seconds: float) -> None:
    assert duration_s(text) == seconds


@pytest.mark.parametrize("text", ["", "5", "-5m", "1y", "m", "2026-03-01", "1e3s", "9" * 400 + "d"])
def test_what_is_none_is_not_taken_for_one(text: str) -> None:
    assert duration_s(text) is None
