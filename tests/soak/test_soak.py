"""Three days of slots with a power failure; the whole soak is `python -m benchmarks.soak`."""

import tempfile
from pathlib import Path

from benchmarks.soak import run

DAYS, DARK_DAYS, MEASURE_EVERY = 3, 1.8, 60


def test_three_days_with_a_power_failure() -> None:
    """Each slot with power and cameras has its row, each other one its gap with the cause."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as directory:
        result = run(DAYS, DARK_DAYS, Path(directory), MEASURE_EVERY)
    assert result.wrong == []
    assert result.slots == 4320
    assert result.gaps["power_loss"] == result.slots - result.powered
    assert result.rows == result.powered - result.gaps["camera_lost"] - result.gaps["calibration"]
    assert result.gaps["camera_lost"] == 10
    assert min(result.flags.values()) > 0
