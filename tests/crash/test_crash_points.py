"""Power cut at every operation of a run: what was promised is kept, and it comes back by itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import pytest

from tests.crash.disk import Tree
from tests.crash.lossy_fs import LossyMount
from tests.crash.promises import Promises
from tests.crash.recording import ABSENCE, CutState, Recording, cut_states, judge, record
from tests.crash.runs import (
    ageing,
    coming_back,
    damaged,
    older_database,
    salvaging,
    thinning,
    two_days,
    two_slots,
    wrong_clock,
)
from tests.exhaustive import IS_ASKED

Judged = list[tuple[CutState, list[str]]]


def nothing(_: Path) -> tuple[Tree, Promises]:
    return {}, Promises()


RUNS = {
    "two days": (two_days, nothing),
    "a wrong clock": (wrong_clock, nothing),
    "old frames": (thinning, ageing),
    "a damaged database": (salvaging, damaged),
    "an older database": (two_slots, older_database),
}
TWICE = 2
"""Recoveries of each run that are cut too,"""
POINTS = 5 if IS_ASKED else 3
"""each at so many points, where all are tried."""


@pytest.fixture(scope="module")
def recordings(mount: LossyMount, scratch: Path) -> dict[str, Recording]:
    return {name: record(mount, run, *before(scratch)) for name, (run, before) in RUNS.items()}


@pytest.fixture(scope="module")
def judged(recordings: dict[str, Recording], scratch: Path) -> dict[str, Judged]:
    return {name: list(judge(run, cut_states(run), scratch)) for name, run in recordings.items()}


@pytest.fixture(scope="module")
def judged_twice(
    recordings: dict[str, Recording], mount: LossyMount, scratch: Path
) -> list[Judged]:
    """Recoveries from some cuts, cut again."""
    found: list[Judged] = []
    for run in recordings.values():
        states = list(cut_states(run))
        for state in states[len(states) // TWICE :: len(states) // TWICE]:
            back = coming_back(run.end_utc + ABSENCE)
            again = record(mount, back, state.tree, state.promised)
            points = list(cut_states(again))
            found.append(list(judge(again, points[:: len(points) // POINTS], scratch)))
    return found


@pytest.mark.parametrize("name", RUNS)
def test_no_cut_breaks_a_promise(judged: dict[str, Judged], name: str) -> None:
    assert broken_ones(judged[name]) == []


def test_no_cut_of_a_recovery_breaks_a_promise(judged_twice: list[Judged]) -> None:
    assert [found for judged in judged_twice for found in broken_ones(judged)] == []


def test_enough_points_were_tried(
    recordings: dict[str, Recording],
    judged: dict[str, Judged],
    judged_twice: list[Judged],
    tally: Callable[[str], None],
) -> None:
    operations = sum(len(run.log) for run in recordings.values())
    states = Counter(state.cut for found in judged.values() for state, _ in found)
    again = sum(map(len, judged_twice))
    kinds = ", ".join(f"{count} {cut}" for cut, count in states.items())
    tally(
        f"crash points: {states.total()} ({kinds}) after {operations} operations,"
        f" {again} in {len(judged_twice)} recoveries; a broken promise fails its test"
    )
    assert states.total() >= 100


def broken_ones(judged: Judged) -> list[str]:
    """The first broken promises, each with its cut."""
    found = (f"{state.cut} after {state.after}: {why}" for state, why in judged if why)
    return list(islice(found, 10))
