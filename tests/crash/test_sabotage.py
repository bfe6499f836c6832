"""The crash tests find what they are there for: each left-out step of a write is noticed."""

from __future__ import annotations

import os
import sqlite3
import stat
from collections.abc import Callable
from pathlib import Path

import pytest
import structlog

from daemon.store import engine, sqlite
from daemon.store.database import Store
from daemon.store.records import MeasurementRecord
from daemon.times import slot_text
from tests.crash.disk import Cut
from tests.crash.lossy_fs import LossyMount
from tests.crash.recording import cut_states, judge, record
from tests.crash.runs import two_slots

Sabotage = Callable[[pytest.MonkeyPatch], None]


def row_never_synced(patch: pytest.MonkeyPatch) -> None:
    weaken(patch, "OFF")


def row_synced_later(patch: pytest.MonkeyPatch) -> None:
    weaken(patch, "NORMAL")


def frame_not_synced(patch: pytest.MonkeyPatch) -> None:
    leave_out(
        patch, lambda file: Path(f"/proc/self/fd/{file}").readlink().name.endswith(".png.tmp")
    )


def directory_not_synced(patch: pytest.MonkeyPatch) -> None:
    leave_out(patch, lambda file: stat.S_ISDIR(os.fstat(file).st_mode))


def acknowledged_before_commit(patch: pytest.MonkeyPatch) -> None:
    commit = Store.add_measurement

    def acknowledge_first(store: Store, record: MeasurementRecord) -> None:
        structlog.get_logger("dcam.daemon").info("slot_done", slot=slot_text(record.slot_utc))
        commit(store, record)

    patch.setattr(Store, "add_measurement", acknowledge_first)


def weaken(patch: pytest.MonkeyPatch, value: str) -> None:
    """Let every connection sync less than FULL."""

    def connect(path: Path) -> sqlite3.Connection:
        connection = sqlite.connect(path)
        connection.execute(f"PRAGMA synchronous={value}").close()
        return connection

    patch.setattr(engine, "connect", connect)


def leave_out(patch: pytest.MonkeyPatch, left_out: Callable[[int], bool]) -> None:
    """Sync nothing of a kind: our own writes only, SQLite's are not Python's."""
    sync = os.fsync

    def seldom(file: int) -> None:
        if not left_out(file):
            sync(file)

    patch.setattr(os, "fsync", seldom)


@pytest.mark.parametrize(
    ("sabotage", "expected"),
    [
        (row_never_synced, "acknowledged row 2026-03-01 23:5"),
        (row_synced_later, "acknowledged row 2026-03-01 23:5"),
        (frame_not_synced, "acknowledged frame frames/2026/03/01/235"),
        (directory_not_synced, "acknowledged frame frames/2026/03/01/235"),
        (acknowledged_before_commit, "acknowledged row 2026-03-01 23:5"),
    ],
)
def test_what_is_left_out_is_noticed(
    mount: LossyMount,
    scratch: Path,
    sabotage: Sabotage,
    expected: str,
    tally: Callable[[str], None],
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        sabotage(patch)
        run = record(mount, two_slots)
    judged = list(judge(run, cut_states(run, [Cut.LOST]), scratch))
    broken = [why for _, why in judged if why]
    tally(f"sabotaged, {sabotage.__name__}: noticed at {len(broken)} of {len(judged)} points")
    assert any(found.startswith(expected) for why in broken for found in why)
