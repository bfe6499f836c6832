"""`dcam-ctl verify`: reads everything, finds what is wrong with it, and says what to do."""

import json
import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from datetime import timedelta
from pathlib import Path

import pytest

from daemon.commands import priority
from daemon.config.reading import load_config
from daemon.schedule import Schedule
from daemon.slots.missing_slots import note_schedule
from daemon.store.database import open_store
from daemon.store.frames.archive import FrameArchive
from daemon.store.records import FrameDay, GapCause, MeasurementRecord, Thinning
from tests.daemon.commands.conftest import Ctl, Ran
from tests.daemon.store.examples import BAD, PERIOD_S, START, pair, record, slot

ROWS = 8
DAY = "frames/2026/03/01"


class Site:
    """A state with eight rows and their frames, and a gap of two slots among them."""

    def __init__(self, state: Path, ctl: Ctl) -> None:
        self.state = state
        self._ctl = ctl
        archive = FrameArchive(state)
        with open_store(state) as store:
            note_schedule(store, Schedule(PERIOD_S))
            for number in (0, 1, 2, 5, 6, 7, 8, 9):
                stored = archive.store(slot(number), pair(number))
                row = MeasurementRecord(
                    slot(number),
                    BAD,
                    config_hash="c0ffee",
                    version="0.1.0",
                    main_frame=stored.main_path,
                    sub_frame=stored.sub_path,
                )
                store.add_measurement(row)
            store.record_gap(slot(3), slot(4), GapCause.CRASH, period_s=PERIOD_S)

    def verify(self, *more: object) -> Ran:
        return self._ctl("--state", self.state, "verify", *more)

    def change(self, *statements: str) -> None:
        """Change the database past the program."""
        with closing(sqlite3.connect(self.state / "dcam.db")) as connection:
            for statement in statements:
                connection.execute(statement)
            connection.commit()


def counts_of(out: str) -> tuple[str | int, ...]:
    """The verdict, and the number that each line after it begins with."""
    verdict, *lines = out.splitlines()
    named = ("rows of the database", "slots of the schedule", "images read")
    assert all(words in line for words, line in zip(named, lines, strict=False))
    return (verdict, *(int(line.split()[0]) for line in lines))


@pytest.fixture
def site(tmp_path: Path, ctl: Ctl) -> Site:
    return Site(tmp_path / "state", ctl)


def test_all_is_well(site: Site) -> None:
    ran = site.verify()
    assert (ran.code, ran.err) == (0, "")
    assert counts_of(ran.out) == ("all well", 12, 10, 16)
    assert {path.name for path in site.state.iterdir()} <= {
        *("dcam.db", "dcam.db-wal", "dcam.db-shm", "frames")
    }


def test_it_reads_at_the_lowest_priority(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """A running dcamd goes first; what comes after is as it was."""
    given, before = [], os.getpriority(os.PRIO_PROCESS, 0)
    monkeypatch.setattr(priority, "_LOWEST", 19)
    monkeypatch.setattr(os, "setpriority", lambda *how: given.append(how))
    assert site.verify().code == 0
    assert given == [(os.PRIO_PROCESS, 0, 19), (os.PRIO_PROCESS, 0, before)]


def removed(*names: str) -> Callable[[Site], object]:
    return lambda site: [(site.state / DAY / name).unlink() for name in names]


def rewritten(name: str) -> Callable[[Site], object]:
    def change(site: Site) -> None:
        path = site.state / DAY / name
        content = bytearray(path.read_bytes())
        content[-20] ^= 1
        path.write_bytes(content)

    return change


def changed(*statements: str) -> Callable[[Site], object]:
    return lambda site: site.change(*statements)


@pytest.mark.parametrize(
    ("harm", "what", "where", "text"),
    [
        (
            changed("UPDATE measurement SET discs_found = 99 WHERE id = 4"),
            "row",
            "dcam.db",
            "a row of measurement, slot_utc 2026-03-01T00:05:00Z, is not what was written",
        ),
        (
            changed("UPDATE measurement SET slot_utc = '2026-03-41T00:05:00Z' WHERE id = 4"),
            "row",
            "dcam.db",
            "a row of measurement, slot_utc 2026-03-41T00:05:00Z, is not what was written",
        ),
        (
            changed(
                "CREATE TEMP TABLE gone AS SELECT 1",
                "DELETE FROM measurement WHERE id = 2",
            ),
            "slots",
            "2026-03-01T00:01:00Z",
            "neither row nor gap",
        ),
        (
            changed("DELETE FROM gap"),
            "slots",
            "2026-03-01T00:03:00Z to 2026-03-01T00:04:00Z (2 slots)",
            "neither row nor gap",
        ),
        (
            changed("PRAGMA foreign_keys=OFF", "UPDATE measurement SET calibration_id = 7"),
            "reference",
            "dcam.db",
            "calibration 7 is not there, but is that of 8 rows from 2026-03-01T00:00:00Z on",
        ),
        (
            removed("000500_main.png"),
            "frame",
            f"{DAY}/000500_main.png",
            "the row of slot 2026-03-01T00:05:00Z names it, it is not there",
        ),
        (
            rewritten("000600_sub.png"),
            "frame",
            f"{DAY}/000600_sub.png",
            "not the image that was stored (sha256 differs)",
        ),
        (
            lambda site: (site.state / DAY / "frames.csv").write_text("nonsense\n"),
            "table",
            DAY,
            "frames.csv",
        ),
        (
            lambda site: (site.state / "dcam.db.damaged-20260301T000000Z").touch(),
            "set aside",
            "dcam.db.damaged-20260301T000000Z",
            "what could be read of it was saved",
        ),
    ],
    ids=["row", "slot", "no row", "no gap", "calibration", "frame", "image", "table", "aside"],
)
def test_what_is_wrong_is_found_and_named(
    site: Site, harm: Callable[[Site], object], what: str, where: str, text: str
) -> None:
    harm(site)
    ran = site.verify("--json")
    assert ran.code == 1
    reported = json.loads(ran.out)
    assert (reported["schema"], reported["command"]) == (1, "verify")
    found = [item for item in reported["findings"] if item["what"] == what]
    assert [item["where"].endswith(where) and text in item["text"] for item in found] == [True]
    assert all(item["todo"] for item in reported["findings"])
    lines = site.verify().out.splitlines(keepends=True)
    number = len(reported["findings"])
    verdict, *counts = counts_of("".join(lines[number:]))
    assert verdict == f"{number} finding{'s' if number > 1 else ''}"
    assert counts[:3] == [reported["rows"], reported["slots"], reported["images"]]


def test_a_slot_in_a_row_and_a_gap_is_found(site: Site) -> None:
    site.change(
        "DROP TRIGGER gap_not_measured_update",
        "UPDATE gap SET start_utc = '2026-03-01T00:01:00Z', slots = 4",
    )
    reported = json.loads(site.verify("--json").out)["findings"]
    doubled = [item["where"] for item in reported if "accounted for twice" in item["text"]]
    assert doubled == ["2026-03-01T00:01:00Z", "2026-03-01T00:02:00Z"]


def test_pages_that_contradict_each_other_are_found(site: Site) -> None:
    with closing(sqlite3.connect(site.state / "dcam.db")) as connection:
        query = "SELECT rootpage FROM sqlite_master WHERE name = 'ix_gap_end_utc'"
        (page,) = connection.execute(query).fetchone()
    with (site.state / "dcam.db").open("r+b") as file:
        file.seek(4096 * (page - 1))
        file.write(bytes(4096))
    ran = site.verify()
    assert ran.code == 1
    assert "database: dcam.db: " in ran.out
    assert "restart dcamd: it sets the file aside" in ran.out


def test_a_stored_pair_without_its_row_is_found_unless_it_is_just_being_measured(
    site: Site,
) -> None:
    archive = FrameArchive(site.state)
    archive.store(slot(4), pair(4))
    archive.store(slot(10), pair(10))
    (found,) = json.loads(site.verify("--json").out)["findings"]
    assert found["text"] == "slot 2026-03-01T00:04:00Z has frames and no row"


def test_damage_is_looked_at_by_the_next_start_and_status_says_so(
    site: Site, ctl: Ctl, bench: Path
) -> None:
    site.change("UPDATE measurement SET discs_found = 99 WHERE id = 4")
    site.verify()
    ran = ctl("--config", bench / "dcam.toml", "--state", site.state, "status", "--json")
    (item,) = [item for item in json.loads(ran.out)["items"] if item["name"] == "database"]
    assert item["level"] == "critical"
    assert item["text"].endswith(
        "is not what was written; restart dcamd, it saves what can be read"
    )


def test_a_database_set_aside_is_critical_until_it_is_moved_away(
    site: Site, ctl: Ctl, bench: Path
) -> None:
    aside = site.state / "dcam.db.damaged-20260301T000000Z"
    aside.touch()
    levels = []
    for _ in range(2):
        ran = ctl("--config", bench / "dcam.toml", "--state", site.state, "status", "--json")
        items = {item["name"]: item["level"] for item in json.loads(ran.out)["items"]}
        levels.append(items["database"])
        aside.unlink(missing_ok=True)
    assert levels == ["critical", "ok"]


def test_frames_that_retention_removed_are_distinguished_from_lost_ones(site: Site) -> None:
    removed("000100_main.png", "000100_sub.png", "000800_main.png")(site)
    day = FrameDay(START.date(), Thinning.HOURLY, until_utc=slot(2), kept=frozenset({slot(2)}))
    with open_store(site.state) as store:
        store.put_frame_day(day)
    reported = json.loads(site.verify("--json").out)
    assert reported["slots_with_frames_removed"] == 1
    (found,) = reported["findings"]
    assert found["where"] == f"{DAY}/000800_main.png"


def test_since_leaves_out_what_is_older(site: Site) -> None:
    removed("000100_main.png")(site)
    site.change("DELETE FROM gap")
    with open_store(site.state) as store:
        day = timedelta(days=1)
        store.record_gap(slot(10), START + 2 * day, GapCause.STOPPED, period_s=PERIOD_S)
    ran = site.verify("--since", "2026-03-02T00:00:00Z")
    assert (ran.code, counts_of(ran.out)[0]) == (0, "all well")
    assert site.verify("--since", "2026-03-01T00:00:00Z").code == 1


def test_slots_follow_the_schedule_of_their_time(site: Site) -> None:
    """From a slot a minute to one in five: nothing is missing before, between or after."""
    with open_store(site.state) as store:
        note_schedule(store, Schedule(300))
        for minute in (10, 15, 20):
            store.add_measurement(record(slot(minute)))
    assert "all well" in site.verify().out
    site.change("DELETE FROM measurement WHERE slot_utc = '2026-03-01T00:15:00Z'")
    (found,) = json.loads(site.verify("--json").out)["findings"]
    assert found["where"] == "2026-03-01T00:15:00Z"


def test_a_running_daemon_is_not_disturbed(site: Site) -> None:
    """It holds the write lock in the middle of a slot; verify neither waits nor makes it wait."""
    with closing(sqlite3.connect(site.state / "dcam.db", isolation_level=None)) as writer:
        writer.execute("BEGIN IMMEDIATE")
        writer.execute("INSERT INTO event VALUES (99, '2026', 'half done', '', 0)")
        assert site.verify().code == 0
        writer.execute("COMMIT")


def test_without_a_noted_schedule_that_of_the_config_is_taken(
    site: Site, ctl: Ctl, bench: Path
) -> None:
    site.change("DELETE FROM mark WHERE name = 'schedules'")
    assert "slots are not looked at" in site.verify().err
    assert load_config(bench / "dcam.toml").schedule.period_s == PERIOD_S
    ran = ctl("--config", bench / "dcam.toml", "--state", site.state, "verify")
    assert counts_of(ran.out) == ("all well", 11, 10, 16)


def test_no_database_is_one_line_and_exit_5(ctl: Ctl, tmp_path: Path) -> None:
    ran = ctl("--state", tmp_path, "verify")
    assert ran.code == 5
    assert ran.err.endswith("no database: start dcamd once, or name another state directory\n")
