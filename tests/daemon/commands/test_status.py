"""`dcam-ctl status` judges a site as a Nagios plugin does."""

from __future__ import annotations

import json
import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from datetime import date, timedelta
from pathlib import Path
from types import SimpleNamespace

import pytest

from daemon.clock.machine import read_boot_id, uptime_s
from daemon.control.run_state import LastSlot, LostCamera, RunState, write_run_state
from daemon.lock import sole_writer
from daemon.store.records import FrameDay, GapCause, Mark
from tests.daemon.commands.conftest import DARK, MINUTE, SIMULATED, START, Ctl, Ran, Site
from tests.daemon.commands.imports import modules_of

DCAM_CTL = str(Path(sys.executable).with_name("dcam-ctl"))


def test_a_site_that_runs_is_ok(site: Site) -> None:
    ran = site.status()
    assert ran.code == 0, ran.out
    document = json.loads(ran.out)
    assert document["schema"] == 1
    assert document["level"] == "ok"
    assert document["last"]["x_mm"] == 0.5
    assert document["last"]["slot_utc"] == "2026-03-01T00:09:00Z"
    assert document["coverage_24h"]["expected"] == document["coverage_24h"]["good"] == 10
    assert document["calibration"] == {
        "id": 1,
        "created_utc": "2026-03-01T00:00:00Z",
        "method": "rigid",
        "passed": True,
        "fits_config": True,
        "datum": None,
    }


@pytest.mark.parametrize(
    ("late", "level", "code"),
    [
        (timedelta(minutes=2), "ok", 0),
        (timedelta(minutes=4), "warning", 1),
        (timedelta(minutes=30), "critical", 2),
    ],
)
def test_age_of_the_last_row_counts(site: Site, late: timedelta, level: str, code: int) -> None:
    site.measure(120)
    ran = site.status(late)
    assert site.levels(ran)["measurement"] == level
    assert ran.code == code


def test_rows_without_a_good_value_are_noticed(site: Site) -> None:
    """Three hours of night: data come, but nothing that can be used."""
    site.measure(180, DARK)
    ran = site.status()
    assert site.levels(ran)["measurement"] == "ok"
    assert site.levels(ran)["last good value"] == "warning"
    assert "too_dark" in ran.out


def test_a_row_from_the_future_is_critical(site: Site) -> None:
    ran = site.status(timedelta(minutes=-5))
    assert site.levels(ran)["measurement"] == "critical"
    assert "is the clock wrong?" in ran.out
    assert ran.code == 2


def test_a_lost_camera_is_critical_until_it_is_back(site: Site) -> None:
    site.measure(200)
    site.miss(2, GapCause.CAMERA_LOST)
    lost = site.status()
    assert site.levels(lost)["cameras"] == "critical"
    site.measure(1)
    back = site.status()
    assert site.levels(back)["cameras"] == "ok"
    assert "camera_lost 2026-03-01T03:30:00Z, 2 slots" in back.out


def test_low_coverage_is_a_warning(site: Site) -> None:
    site.miss(3, GapCause.OVERRUN)
    site.measure(7)
    ran = site.status()
    assert site.levels(ran)["coverage 24 h"] == "warning"
    assert json.loads(ran.out)["coverage_24h"]["gaps"] == {"overrun": 3}


def test_slots_that_nothing_accounts_for_are_counted(site: Site) -> None:
    ran = site.status(timedelta(minutes=5))
    assert json.loads(ran.out)["coverage_24h"]["unaccounted"] == 4


@pytest.mark.parametrize("second", [0, 1, 59])
def test_a_day_has_as_many_slots_in_each_second_of_a_period(site: Site, second: int) -> None:
    ran = site.status(timedelta(days=40, seconds=second))
    document = json.loads(ran.out)
    assert document["coverage_24h"]["expected"] == 24 * 60
    assert document["coverage_30d"]["expected"] == 30 * 24 * 60


@pytest.mark.parametrize(
    ("marks", "level", "reported"),
    [
        ({}, "warning", "never ran here"),
        ({Mark.HEARTBEAT_UTC: START.isoformat()}, "critical", "died after 2026-03-01T00:00:00Z"),
        (
            {Mark.HEARTBEAT_UTC: START.isoformat(), Mark.CLEAN_STOP_UTC: START.isoformat()},
            "warning",
            "stopped in order",
        ),
    ],
)
def test_a_daemon_that_does_not_run_is_a_state_of_its_own(
    site: Site, marks: dict[Mark, str], level: str, reported: str
) -> None:
    for mark, value in marks.items():
        site.write(lambda store, m=mark, v=value: store.set_mark(m, v))
    ran = site.status(running=False)
    assert site.levels(ran)["daemon"] == level
    assert reported in ran.out


def test_looking_does_not_take_the_lock_from_a_daemon_that_starts(site: Site) -> None:
    """The lock can be taken at any time beside a status; it is only read about."""
    site.status(running=False)
    with sole_writer(site.state):
        assert site.levels(site.ctl("status", "--json", "--at", site.end))["daemon"] == "ok"


TWO_DISKS = """
for disk in "$1" "$2"; do
  mkdir "$disk" && mount -t tmpfs disk "$disk" || exit 77
  : > "$disk"/dcamd.lock; cp -R "$0"/. "$disk"
done
shift 2
flock "$@"
"""
"""New disks number their files alike."""


@pytest.mark.parametrize("holds", [True, False])
def test_a_lock_on_another_disk_is_not_taken_for_dcamd(
    site: Site, tmp_path: Path, holds: bool
) -> None:
    """Its file has the same number there as the lock of this state has here."""
    disks = [str(tmp_path / name) for name in ("its", "another")]
    held = Path(disks[0 if holds else 1], "dcamd.lock")
    ran = subprocess.run(
        [
            *("unshare", "-Urm", "sh", "-c", TWO_DISKS, str(site.state), *disks, str(held)),
            *(DCAM_CTL, "--config", str(site.config), "--state", disks[0], "status", "--json"),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    if ran.returncode == 77 or "unshare" in ran.stderr:
        pytest.skip(f"no mount without root here: {ran.stderr.strip()}")
    daemon = next(it for it in json.loads(ran.stdout)["items"] if it["name"] == "daemon")
    assert daemon["text"].startswith("running" if holds else "never ran here")


def says(site: Site, silent_s: float = 0.0, **what: object) -> Ran:
    """`status --json` beside a daemon that last wrote this of itself."""
    state = RunState(
        **{"pid": os.getpid(), "boot_id": read_boot_id(), "version": "1.0", "started_utc": ""}
        | {"phase": "running", "patience_s": 300.0, "reported_s": uptime_s() - silent_s}
        | what
    )
    write_run_state(site.state, state)
    return site.status()


def item(ran: Ran, name: str) -> tuple[str, str]:
    (found,) = (item for item in json.loads(ran.out)["items"] if item["name"] == name)
    return found["level"], found["text"]


def test_what_the_daemon_does_now_is_reported(site: Site) -> None:
    ran = says(site, phase="recovering", silent_s=20.0)
    assert item(ran, "daemon") == ("ok", "recovering, 20 s ago")
    assert json.loads(ran.out)["daemon"]["says"]["phase"] == "recovering"
    ran = says(site, phase="paused", reason="calibration (pid 7)")
    assert item(ran, "daemon") == ("ok", "paused, 0 s ago: calibration (pid 7)")


def test_a_daemon_that_runs_but_ends_no_slot_is_critical(site: Site) -> None:
    level, text = item(says(site, silent_s=3600.0), "daemon")
    assert (level, text[:36]) == ("critical", "hangs: no slot has ended for 1 h; jo")


@pytest.mark.parametrize(
    "stale",
    [{"pid": 2**22 + 1}, {"boot_id": "another"}, {"phase": "dancing"}, {"reported_s": "soon"}],
)
def test_what_an_earlier_daemon_left_is_not_believed(site: Site, stale: dict) -> None:
    ran = says(site, silent_s=3600.0, **stale)
    assert item(ran, "daemon") == ("ok", "running")


@pytest.mark.parametrize("garbage", [b"", b"{", b"[]", b"{}", b"\xff", b'{"schema": 1}', b"null"])
def test_a_state_file_that_is_none_is_no_obstacle(site: Site, garbage: bytes) -> None:
    (site.state / "state.json").write_bytes(garbage)
    assert item(site.status(), "daemon") == ("ok", "running")


def test_a_camera_is_lost_from_the_moment_the_daemon_says_so(site: Site) -> None:
    ran = says(site, lost={"sub": LostCamera("2026-03-01T00:09:00Z", "sub camera: unplugged")})
    reported = "sub lost since slot 2026-03-01T00:09:00Z: sub camera: unplugged"
    assert item(ran, "cameras") == ("critical", reported)
    assert ran.code == 2


def test_slots_that_fail_in_a_row_are_a_warning_with_their_cause(site: Site) -> None:
    last = LastSlot("2026-03-01T00:09:00Z", "missed", "disk_full", "no space")
    level, text = item(says(site, failed_in_a_row=4, last=last), "supervision")
    assert level == "warning"
    assert text == "4 slots in a row without a row (disk_full: no space), 0 starts in 24 h"


def test_a_daemon_that_is_started_again_and_again_is_a_warning(site: Site) -> None:
    for _ in range(5):
        site.write(lambda store: store.add_event(site.end, "started"))
    assert item(site.status(), "supervision") == ("ok", "no slot failing, 5 starts in 24 h")
    site.write(lambda store: store.add_event(site.end, "started"))
    assert site.levels(site.status())["supervision"] == "warning"


@pytest.mark.parametrize(
    ("free_bytes", "total_bytes", "level"),
    [
        (100e6, 1e9, "critical"),
        (900e6, 2e9, "warning"),
        (4e9, 100e9, "warning"),
        (6e9, 100e9, "ok"),
    ],
)
def test_a_nearly_full_disk_is_noticed_before_any_pair_is_kept(
    site: Site, monkeypatch, free_bytes: float, total_bytes: float, level: str
) -> None:
    usage = SimpleNamespace(free=int(free_bytes), total=int(total_bytes))
    monkeypatch.setattr("daemon.status.facts.shutil.disk_usage", lambda _path: usage)
    assert site.levels(site.status())["disk"] == level


def test_frames_that_are_not_kept_are_reported_until_they_are_again(site: Site) -> None:
    site.measure(2)
    why = "from slot 2026-03-01T00:02:00Z: the disk is full"
    site.write(lambda store: store.add_event(site.end, "frames_not_kept", why))
    ran = site.status()
    assert site.levels(ran)["frames"] == "warning"
    assert "not kept from slot 2026-03-01T00:02:00Z: the disk is full" in ran.out
    site.write(lambda store: store.add_event(site.end, "frames_kept_again", "from slot x"))
    assert site.levels(site.status())["frames"] == "ok"


def test_the_size_of_the_archive_is_reported_without_walking_it(site: Site) -> None:
    for number in (1, 2):
        day = FrameDay(date(2026, 2, number), bytes=3_000_000_000)
        site.write(lambda store, day=day: store.put_frame_day(day))
    ran = site.status()
    assert "frames of 2 days take 6 GB" in ran.out
    assert json.loads(ran.out)["disk"]["archive_bytes"] == 6_000_000_000


def test_rows_that_could_not_keep_their_frames_are_a_warning_for_a_day(site: Site) -> None:
    site.measure(2, frame=None)
    ran = site.status()
    assert site.levels(ran)["frames"] == "warning"
    assert json.loads(ran.out)["frames_not_kept_24h"] == 2
    assert site.levels(site.status(timedelta(hours=25)))["frames"] == "ok"


def test_no_calibration_is_critical(tmp_path: Path, ctl: Ctl) -> None:
    site = Site(tmp_path, ctl)
    site.measure(1, DARK)
    ran = site.status()
    assert site.levels(ran)["calibration"] == "critical"
    assert "run dcam-ctl calibrate" in ran.out


@pytest.mark.parametrize(
    ("change", "reported"),
    [({"config_hash": "0" * 64}, "config has changed"), ({"passed": False}, "did not pass")],
)
def test_a_doubtful_calibration_is_a_warning(site: Site, change, reported: str) -> None:
    site.calibrate(**change)
    ran = site.status()
    assert site.levels(ran)["calibration"] == "warning"
    assert reported in ran.out


def test_without_a_database_it_is_unknown(ctl: Ctl, tmp_path: Path) -> None:
    ran = Site(tmp_path, ctl).ctl("status")
    assert ran.code == 3
    assert ran.out.startswith("DCAM UNKNOWN - ")


@pytest.mark.parametrize(
    "words",
    [
        ["status", "--jsn"],
        ["--nonsense", "status"],
        ["status", "--at", "noon"],
        ["--config", "/nowhere/dcam.toml", "status"],
    ],
)
def test_what_keeps_it_from_a_verdict_is_unknown_in_one_line_on_stdout(
    site: Site, words: list[str]
) -> None:
    ran = site.ctl(*words)
    (line,) = ran.out.splitlines()
    assert line.startswith("DCAM UNKNOWN - ")
    assert (ran.code, ran.err) == (3, "")


def test_a_config_with_several_faults_is_unknown_and_still_json(site: Site) -> None:
    site.config.write_text(SIMULATED.replace("= 8.0", "= -8.0").replace("= 4.0", "= -4.0"))
    ran = site.ctl("status", "--json")
    assert ran.code == 3
    document = json.loads(ran.out)
    assert (document["level"], document["code"]) == ("unknown", 3)
    assert "diameter_mm" in document["error"]
    assert "square_mm" in document["error"]


def test_a_newer_database_is_unknown_and_a_damaged_one_critical(site: Site) -> None:
    database = site.state / "dcam.db"
    with closing(sqlite3.connect(database)) as connection, connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
    newer = site.ctl("status", "--json")
    assert (newer.code, json.loads(newer.out)["level"]) == (3, "unknown")
    assert site.ctl("gaps").code == 5
    database.write_bytes(b"not a database at all" * 1000)
    damaged = site.ctl("status")
    assert damaged.code == 2
    assert damaged.out.startswith("DCAM CRITICAL - ")


def test_first_line_is_what_a_monitoring_system_shows(site: Site) -> None:
    """One line with verdict and value; last, behind a bar, the figures, as of Nagios plugins."""
    with sole_writer(site.state):
        ran = site.ctl("status", "--at", "2026-03-01T00:09:30Z")
    first, answers, table, _ = ran.out.split("\n\n")
    header, *rest = table.splitlines()
    assert first.startswith("DCAM OK - bench: x +0.500 ± 0.100 mm, y -1.250 ± 0.200 mm, 30 s ago")
    assert len(first) <= 80
    _, figures = ran.out.split("|")
    assert "age=30s" in figures.split()
    assert "coverage_24h=100.00%" in figures.split()
    assert answers.startswith("measuring  yes, ")
    assert header.split() == ["what", "state", "as", "of", "2026-03-01T00:09:30Z"]
    assert len([line for line in rest if line[0] != " "]) == 14
    assert "\x1b" not in ran.out
    assert "─" not in ran.out


def test_status_loads_no_numerics_no_orm_and_no_logger(site: Site) -> None:
    """A monitoring system asks every minute: it shall not wait for what only a slot needs."""
    at = (site.end - MINUTE).isoformat()
    where = ("--config", site.config, "--state", site.state)
    with sole_writer(site.state):
        loaded = modules_of(*where, "status", "--at", at)
    slow = {"scipy", "cv2", "numba", "sqlalchemy", "alembic", "apscheduler", "structlog"}
    assert slow.isdisjoint(loaded)
