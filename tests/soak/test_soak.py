"""Two days of slots with a power failure; the whole soak is `python -m benchmarks.soak`."""

import tempfile
from pathlib import Path

import pytest

from benchmarks import soak
from benchmarks.soak_history import History
from tests.programs import Forked

HISTORY = History.of(2, 1.3, bright_days=0.6)
"""Each camera is lost once and somebody calibrates once before the power fails."""
MEASURE_EVERY, FAIR_MIN = 60, 60
"""An image an hour: to render and measure them takes most of the time."""


def test_two_days_with_a_power_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each slot with power and cameras has its row, each other one its gap with the cause."""
    monkeypatch.setattr(soak, "subprocess", Forked)
    monkeypatch.setattr(soak, "STATUS_RUNS", 1)  # a figure of the benchmark
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as directory:
        result = soak.run(HISTORY, Path(directory), MEASURE_EVERY, FAIR_MIN)
    assert result.wrong == []
    assert result.slots == 2880
    assert result.gaps["power_loss"] == result.slots - result.powered
    assert result.rows == result.powered - result.gaps["camera_lost"] - result.gaps["calibration"]
    assert result.gaps["camera_lost"] == 10
    assert min(result.flags.values()) > 0
