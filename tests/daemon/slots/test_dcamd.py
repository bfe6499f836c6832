"""dcamd as its operator meets it: a process that is started, stopped, killed and started again."""

import os
import re
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from uuid import UUID

import pytest

from daemon.clock.machine import BOOT_ID_VARIABLE
from daemon.store.database import Store, open_store
from daemon.store.records import GapCause, Mark
from tests.laboratory import laboratory
from tests.programs import Program, ran, traced
from tests.waiting import PATIENCE_S

DCAMD = [sys.executable, "-m", "daemon.main"]
ROOT = Path(__file__).parents[3]
SITE = laboratory(320, "simulated")
REAL_TIME = '[schedule]\nperiod_s = 1\n[simulation]\nclock = "system"\n'
MARCH = datetime(2026, 3, 1, tzinfo=UTC)


class Site:
    """A config, a state directory, and a socket on which dcamd tells how it is."""

    def __init__(self, directory: Path) -> None:
        self.config = directory / "dcam.toml"
        self.state = directory / "state"
        self.log = directory / "log"
        self.manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.address = str(directory / "notify")
        self.manager.bind(self.address)
        self.manager.settimeout(PATIENCE_S)

    def close(self) -> None:
        self.manager.close()

    def configure(self, more: str = "") -> None:
        self.config.write_text(SITE + more)

    def where(self) -> tuple[str, ...]:
        return "--config", str(self.config), "--state", str(self.state)

    def environ(self) -> dict[str, str]:
        return os.environ | {"NOTIFY_SOCKET": self.address}

    def run(self, *more: str) -> subprocess.CompletedProcess[str]:
        environ = os.environ | {"NOTIFY_SOCKET": ""}
        return ran("daemon.main", *self.where(), *more, env=environ)

    def run_below(self, before: tuple[str, ...], *more: str) -> subprocess.CompletedProcess[str]:
        """As the child of another program, and so with a Python that loads all by itself."""
        return subprocess.run(
            [*before, *DCAMD, *self.where(), *more],
            cwd=ROOT,
            env=os.environ | {"NOTIFY_SOCKET": ""},
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )

    def start(self, *more: str) -> Program:
        return Program("daemon.main", *self.where(), *more, env=self.environ(), stderr=self.log)

    def notified(self, pattern: str) -> str:
        """Wait until dcamd says something to its service manager."""
        while True:
            text = self.manager.recv(1000).decode()
            if re.search(pattern, text):
                return text

    def acknowledged(self, text: str) -> set[datetime]:
        """The slots that a log says are done."""
        found = re.findall(r"event=slot_done slot=(\S+)", text)
        return {datetime.fromisoformat(slot) for slot in found}

    def store(self) -> Store:
        return open_store(self.state, create=False)


@pytest.fixture
def site(tmp_path: Path):
    with closing(Site(tmp_path)) as site:
        site.configure()
        yield site


def state_after(directory: Path, slots: int, more: str = "") -> Path:
    """The state directory of a dcamd that ran so many slots and ended; to be copied."""
    with closing(Site(directory)) as site:
        site.configure(more)
        result = site.run("--max-slots", str(slots))
        assert result.returncode == 0, result.stderr
        return site.state


@pytest.fixture(scope="module")
def after_two_slots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return state_after(tmp_path_factory.mktemp("two"), 2)


def unaccounted(store: Store, period_s: int = 60) -> int:
    first, last = store.accounted()
    return store.coverage(first, last + timedelta(seconds=1), period_s=period_s).unaccounted


def test_runs_its_slots_faster_than_time_and_ends(site: Site) -> None:
    """A camera is lost for three minutes: a gap with that cause, and rows again after it."""
    site.configure(
        '[[simulation.scenarios]]\nkind = "camera_loss"\nrole = "sub"\nstart_min = 3\nend_min = 6\n'
    )
    process = site.start("--max-slots", "8")
    site.notified(r"^READY=1$")
    site.notified(r"^STATUS=slot 2026-03-01T00:03:00Z missed: camera_lost$")
    site.notified(r"^STATUS=slot 2026-03-01T00:07:00Z done: bad$")
    site.notified(r"^STOPPING=1$")
    assert process.wait(PATIENCE_S) == 0
    with site.store() as store:
        rows = store.measured_slots()
        assert rows == {MARCH + timedelta(minutes=minute) for minute in (0, 1, 2, 6, 7)}
        assert rows == site.acknowledged(site.log.read_text())
        (gap,) = store.gaps()
        assert (gap.slots, gap.cause) == (3, GapCause.CAMERA_LOST)
        assert gap.detail.startswith("sub camera")
        assert unaccounted(store) == 0
        assert store.get_mark(Mark.CLEAN_STOP_UTC)
        assert [event.kind for event in store.events()] == [
            *("started", "camera_lost", "slots_again", "stopped")
        ]


def test_simulated_time_goes_on_after_a_restart(site: Site) -> None:
    for _ in range(2):
        result = site.run("--max-slots", "2")
        assert result.returncode == 0, result.stderr
    with site.store() as store:
        assert sorted(store.measured_slots()) == [MARCH + timedelta(minutes=m) for m in range(4)]
        assert store.gaps() == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_ends_the_slot_and_closes_cleanly(site: Site, number: signal.Signals) -> None:
    site.configure(REAL_TIME)
    process = site.start()
    site.notified(r"^STATUS=slot .* done")
    process.send_signal(number)
    site.notified(r"^STOPPING=1$")
    assert process.wait(PATIENCE_S) == 0
    log = site.log.read_text()
    with site.store() as store:
        assert store.measured_slots() == site.acknowledged(log)
        assert store.get_mark(Mark.CLEAN_STOP_UTC)
    assert not list(site.state.glob("dcam.db-wal"))


def test_second_dcamd_on_the_same_state_is_refused(site: Site) -> None:
    site.configure(REAL_TIME)
    first = site.start()
    try:
        site.notified(r"^READY=1$")
        second = site.run("--max-slots", "1")
        assert second.returncode == 4
        (line,) = second.stderr.splitlines()
        assert f"in use by dcamd (pid {first.pid})" in line
    finally:
        first.send_signal(signal.SIGTERM)
    assert first.wait(PATIENCE_S) == 0


def test_killed_and_started_again_nothing_acknowledged_is_lost(site: Site) -> None:
    site.configure(REAL_TIME)
    process = site.start()
    for _ in range(2):
        site.notified(r"^STATUS=slot .* done")
    process.kill()
    process.wait(PATIENCE_S)
    acknowledged = site.acknowledged(site.log.read_text())
    assert len(acknowledged) >= 2

    result = site.run("--max-slots", "2")

    assert result.returncode == 0, result.stderr
    with site.store() as store:
        assert acknowledged <= store.measured_slots()
        assert unaccounted(store, period_s=1) == 0
        assert store.measured_slots() >= site.acknowledged(result.stderr)


@pytest.mark.parametrize(
    ("second_boot", "cause"),
    [("B" * 32, GapCause.POWER_LOSS), ("a" * 32, GapCause.CRASH)],
    ids=["another boot", "the same boot"],
)
def test_the_boot_that_systemd_names_tells_a_cut_from_a_crash(
    site: Site, monkeypatch: pytest.MonkeyPatch, second_boot: str, cause: GapCause
) -> None:
    """A container is cut while the kernel below it goes on; systemd names both without dashes."""
    monkeypatch.setenv(BOOT_ID_VARIABLE, str(UUID("a" * 32)))
    process = site.start()
    site.notified(r"^STATUS=slot .* done")
    process.kill()
    process.wait(PATIENCE_S)
    monkeypatch.setenv(BOOT_ID_VARIABLE, second_boot)
    site.configure("[simulation]\nclock_start_utc = 2028-03-01T00:00:30Z\n")

    assert site.run("--max-slots", "1").returncode == 0

    with site.store() as store:
        assert {gap.cause for gap in store.gaps()} == {cause}
        assert store.get_mark(Mark.BOOT_ID) == str(UUID(second_boot))


def run_on_small_disk(site: Site, slots: int) -> subprocess.CompletedProcess[str]:
    """On a disk of 1.5 MB, so real ENOSPC."""
    site.state.mkdir()
    disk = 'mount -t tmpfs -o size=1500k tmpfs "$0" || exit 77; exec "$@"'
    result = site.run_below(
        ("unshare", "-Urm", "sh", "-c", disk, str(site.state)), "--max-slots", str(slots)
    )
    if result.returncode == 77 or "unshare" in result.stderr:
        pytest.skip(f"no mount without root here: {result.stderr.strip()}")
    return result


def test_full_disk_never_ends_the_daemon(site: Site) -> None:
    """With nothing held back rows find no room either; all 30 slots are gone through."""
    site.configure("[retention]\nreserve_mb = 0\n")
    result = run_on_small_disk(site, 30)
    reported = re.findall(r"event=slot_(done|missed) slot=(\S+)(?: cause=(\w+))?", result.stderr)
    assert len({slot for _, slot, _ in reported}) == 30
    assert {cause for event, _, cause in reported if event == "missed"} == {"disk_full"}
    assert result.stderr.count("event=frames_not_kept") == 1
    assert result.returncode == 5
    assert result.stderr.splitlines()[-1].startswith("dcamd: error: ")


def test_small_disk_costs_the_frames_and_no_row(site: Site) -> None:
    """As long as what rows need is not free, no frame is kept; it is reported once."""
    result = run_on_small_disk(site, 30)
    assert result.returncode == 0, result.stderr
    assert len(site.acknowledged(result.stderr)) == 30
    assert result.stderr.count("event=frames_not_kept") == 1


def test_days_of_slots_stay_within_the_rules(site: Site) -> None:
    """Four slots a day for a week: all of the last day, one of the one before, no older ones."""
    site.configure(
        "[schedule]\nperiod_s = 21600\n"
        "[retention]\nevery_slot_days = 1\nhourly_days = 1\nframes_days = 2\n"
        "min_free_gb = 0.0\nreserve_mb = 0\n"
    )
    assert site.run("--max-slots", "28").returncode == 0
    days = sorted((site.state / "frames").glob("*/*/*"))
    counts = [len(list(day.glob("*_main.png"))) for day in days]
    # The first day is kept at its start, the last pairs by their age.
    assert counts[-2:] == [1, 4]
    assert sum(counts[:-2]) <= 2
    with site.store() as store:
        rows = list(store.measurements())
        assert len(rows) == 28
        gone = [row for row in rows if not (site.state / str(row.main_frame)).exists()]
        assert len(gone) == 28 - sum(counts)
        assert all(store.frames_removed(row.slot_utc) for row in gone)


STEPS = {
    "main frame written": r"/\.\d+_main\.png\.tmp",
    "sub frame written": r"/\.\d+_sub\.png\.tmp",
    "pair entered in its table": r"/frames\.csv",
    "row going into the log": r"/dcam\.db-wal",
}
"""The syncs of a slot by the file they are of; a kill arrives as the call is entered."""


def slot_under_strace(site: Site, *options: str) -> int:
    """How a dcamd of one slot ends."""
    return traced(options, "daemon.main", *site.where(), "--max-slots", 1, stderr=site.log)


@pytest.fixture(scope="module")
def syncs(after_two_slots: Path, tmp_path_factory: pytest.TempPathFactory) -> list[tuple[str, str]]:
    """Call and path of each sync of the third slot's dcamd, in order, as strace saw them."""
    with closing(Site(tmp_path_factory.mktemp("syncs"))) as site:
        site.configure()
        shutil.copytree(after_two_slots, site.state)
        trace = site.state / "trace"
        code = slot_under_strace(site, "-y", "-o", str(trace), "-e", "trace=fsync,fdatasync")
    assert code == 0
    found = re.findall(r"(fsync|fdatasync)\(\d+<([^>]*)>", trace.read_text())
    assert found
    return found


@pytest.mark.parametrize("step", STEPS)
def test_killed_at_a_write_every_slot_is_accounted_for(
    site: Site, after_two_slots: Path, syncs, step: str
) -> None:
    """The third slot is killed in the middle of its writes; ten minutes later dcamd comes back."""
    shutil.copytree(after_two_slots, site.state)
    # Of the log many syncs are marks and events: the row's is the first after the table's.
    table = next(i for i, (_, path) in enumerate(syncs) if path.endswith("/frames.csv"))
    begin = table if "log" in step else 0
    at = next(i for i, (_, path) in enumerate(syncs) if i >= begin and re.search(STEPS[step], path))
    call = syncs[at][0]
    when = [name for name, _ in syncs[: at + 1]].count(call)

    what = ("-e", f"trace={call}", "-e", f"inject={call}:signal=KILL:when={when}")
    assert slot_under_strace(site, "-o", "/dev/null", *what) == -signal.SIGKILL

    acknowledged = site.acknowledged(site.log.read_text())
    assert acknowledged == set()
    site.configure("[simulation]\nclock_start_utc = 2026-03-01T00:10:30Z\n")
    again = site.run("--max-slots", "1")
    assert again.returncode == 0, again.stderr
    with site.store() as store:
        minutes = {(slot - MARCH) // timedelta(minutes=1) for slot in store.measured_slots()}
        pair_was_whole = step in {"pair entered in its table", "row going into the log"}
        assert minutes == ({0, 1, 2, 11} if pair_was_whole else {0, 1, 11})
        assert {gap.cause for gap in store.gaps()} == {GapCause.CRASH}
        assert unaccounted(store) == 0
        assert sum(gap.slots for gap in store.gaps()) == 12 - len(minutes)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[shedule]\nperiod_s = 60\n", "shedule: unknown key; did you mean schedule?"),
        ("[schedule]\nperiod_s = -1\n", "schedule.period_s: must be at least 1, is -1"),
    ],
)
def test_config_mistake_is_one_line_and_exit_3(site: Site, text: str, complaint: str) -> None:
    site.configure(text)
    result = site.run()
    assert result.returncode == 3
    assert result.stderr.splitlines() == [f"dcamd: error: {site.config}: {complaint}"]
    assert not site.state.exists()


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ('backend = "simulated"\n', "", "camera.main.backend: not set; use aravis or"),
        (
            'backend = "simulated"\n',
            'backend = "harvesters"\n',
            "camera.sub.backend: simulated, but the main camera's is harvesters",
        ),
        (
            'backend = "simulated"\n',
            'backend = "aravis"\n',
            "camera.sub.backend: simulated, but the main camera's is aravis",
        ),
    ],
)
def test_dcamd_says_what_a_config_for_frame_sets_lacks(site, old, new, complaint) -> None:
    site.config.write_text(SITE.replace(old, new, 1))
    result = site.run()
    assert result.returncode == 3
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"dcamd: error: {site.config}: {complaint}")


def test_usage_mistake_is_one_line_and_exit_2(site: Site) -> None:
    result = site.run("--max-slots", "0")
    assert result.returncode == 2
    assert len(result.stderr.splitlines()) == 1


def test_database_of_another_program_is_one_line_and_exit_5(site: Site) -> None:
    site.state.mkdir()
    with closing(sqlite3.connect(site.state / "dcam.db")) as connection:
        connection.execute("CREATE TABLE notes (text)")
    result = site.run("--max-slots", "1")
    assert result.returncode == 5
    (line,) = result.stderr.splitlines()
    assert "a SQLite database, but not one of this program" in line
    assert [path.name for path in site.state.glob("dcam.db*")] == ["dcam.db"]
