"""How long the room lasts, checked by living through it."""

import math

import pytest

from daemon.retention.outlook import Archive, days_until_short
from daemon.retention.rules import Rules
from daemon.store.records import Thinning

GB = 1e9
RULES = Rules(every_slot_days=30, hourly_days=365, min_free_gb=5.0)


def lived(rules: Rules, day_bytes: float, free_bytes: float, slots_a_day: int) -> int | None:
    """Days until the free space is below the floor, day by day from an empty archive."""
    share = {
        Thinning.EVERY_SLOT: 1.0,
        Thinning.HOURLY: 24 / slots_a_day,
        Thinning.DAILY: 1 / slots_a_day,
        Thinning.EVENTS: 0.0,
    }
    total = 0.0
    for day in range(5000):
        total += share[rules.level_due(day)]
        if free_bytes - total * day_bytes < rules.min_free_bytes:
            return day
    return None


@pytest.mark.parametrize("free_gb", [20.0, 120.0, 230.0, 400.0])
def test_it_is_as_long_as_living_through_it(free_gb: float) -> None:
    expected = lived(RULES, 6 * GB, free_gb * GB, 1440)
    found = days_until_short(RULES, Archive(0, 0), 6 * GB, 1440, free_gb * GB)
    if expected is None:
        assert found is None or found > 4999
    else:
        assert found == pytest.approx(expected, abs=1.01)


def test_with_an_end_it_may_last_for_ever() -> None:
    rules = Rules(every_slot_days=30, hourly_days=365, frames_days=1000)
    assert days_until_short(rules, Archive(0, 0), 6 * GB, 1440, 300 * GB) is None
    assert days_until_short(rules, Archive(100, 200 * GB), 6 * GB, 1440, 100 * GB) is None


def test_a_limit_of_size_counts_as_well() -> None:
    rules = Rules(frames_max_gb=60.0)
    found = days_until_short(rules, Archive(5, 30 * GB), 6 * GB, 1440, math.inf)
    assert found == pytest.approx(5.0, abs=0.02)
    assert days_until_short(rules, Archive(10, 61 * GB), 6 * GB, 1440, math.inf) == 0.0
