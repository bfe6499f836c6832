"""`dcam-ctl redate`: an operator says when pairs of a wrong clock were taken, and gets a record."""

import json
from datetime import timedelta

import pytest

from daemon.config.readings import ReadingSection
from daemon.ctl import cli
from daemon.error_report import run
from daemon.readings.sampler import Probe, Sampler
from tests.daemon.commands.conftest import CONFIG
from tests.daemon.times import minute_of, slot

WRONG = timedelta(days=900)
AGAIN = "dcamd will measure them again as of their true times, between its slots\n"


@pytest.fixture
def ctl(station, tmp_path, capsys):
    """Run a command on the station's state; gives exit code, stdout and stderr."""
    config = tmp_path / "dcam.toml"
    config.write_text(CONFIG, encoding="utf-8")

    def command(*arguments: str):
        capsys.readouterr()
        paths = ["--config", str(config), "--state", str(station.state)]
        code = run(cli, "dcam-ctl", [*arguments, *paths])
        said = capsys.readouterr()
        return code, said.out, said.err

    return command


@pytest.fixture
def redate(ctl):
    """Run `dcam-ctl redate`."""
    return lambda *arguments: ctl("redate", *arguments)


class Counting:
    """A sensor that says how often it was asked."""

    bus = "counting"
    said = 0

    def read(self, timeout_s: float) -> float:
        self.said += 1
        return float(self.said)

    def stop(self) -> None:
        pass


def test_readings_go_with_their_pair(station, redate) -> None:
    """Row and frames, undated and dated again."""
    section = ReadingSection.model_validate({"name": "air", "unit": "degC", "file": "/x"})
    station.readings = Sampler([Probe(section, Counting())], patient=True)
    station.run(2)
    station.clock.advance(7_230)
    station.clock.set_utc(station.clock.now_utc() - WRONG)
    station.run(3, boot_id="boot-2")
    assert [record.reading_values for _, record in station.store.undated()] == [
        *({"air": 3.0}, {"air": 4.0}, {"air": 5.0})
    ]
    code, _, _ = redate("--boot", "boot-2", "--booted", "2026-03-01T14:01:30Z")
    assert code == 0
    rows = {minute_of(row.slot_utc): row.reading_values for row in station.store.measurements()}
    assert rows == {0: {"air": 1.0}, 1: {"air": 2.0}} | {
        120 + k: {"air": 1.0 + k} for k in (2, 3, 4)
    }
    for minute in (122, 123, 124):
        assert station.archive.load(slot(minute)).readings == rows[minute]
    station.readings.close()


@pytest.fixture
def woken(station):
    """The power failed after 12:01; up at 14:01:30 with a clock of years ago, for three pairs."""
    station.run(2)
    station.clock.advance(7_230)
    station.clock.set_utc(station.clock.now_utc() - WRONG)
    station.run(3, boot_id="boot-2")
    station.clock.advance(90)
    station.clock.set_utc(station.clock.now_utc() + WRONG)
    station.run(1, boot_id="boot-3")
    return station


def test_what_waits_is_listed(woken, redate) -> None:
    code, out, _ = redate()
    assert code == 0
    assert "boot-2" in out
    assert "2023-09-13T14:02:00Z" in out
    _, out, _ = redate("--json")
    (boot,) = json.loads(out)["undated"]
    assert (boot["boot_id"], boot["pairs"], boot["first_uptime_s"]) == ("boot-2", 3, 30)


def test_status_tells_of_pairs_that_wait(woken, ctl) -> None:
    _, out, _ = ctl("status")
    words = " ".join(out.split())  # the table is wrapped
    assert "3 pairs taken under a wrong clock have no slot yet: dcam-ctl redate" in words


def test_nothing_waits(station, redate) -> None:
    station.run(1)
    assert redate()[:2] == (0, "no undated pairs\n")


@pytest.mark.parametrize(
    "how", [["--booted", "2026-03-01T14:01:30Z"], ["--shift", str(WRONG.total_seconds())]]
)
def test_undated_pairs_get_their_slots_in_the_gap(woken, redate, how) -> None:
    assert woken.gaps() == [(2, 125, "power_loss")]
    code, out, _ = redate("--boot", "boot-2", *how)
    assert (code, out) == (0, f"3 undated pairs dated, 0 rows moved\n{AGAIN}")
    assert woken.minutes() == [0, 1, 122, 123, 124, 126]
    assert woken.gaps() == [(2, 121, "power_loss"), (125, 125, "power_loss")]
    row = woken.store.measurement(slot(123))
    assert row.redated_from_utc == slot(123) - WRONG
    assert (woken.state / row.main_frame).is_file()
    assert "by hand: 3 dated" in woken.store.events(kind="redated")[0].detail


def test_a_dry_run_tells_and_changes_nothing(woken, redate) -> None:
    code, out, _ = redate("--boot", "boot-2", "--booted", "2026-03-01T14:01:30Z", "--dry-run")
    assert (code, out) == (0, "3 undated pairs would be dated, 0 rows would be moved\n")
    assert woken.minutes() == [0, 1, 126]
    assert len(woken.store.undated()) == 3


def test_slots_that_have_rows_are_never_overwritten(woken, redate) -> None:
    before = woken.store.measurement(slot(126))
    code, out, _ = redate("--boot", "boot-2", "--booted", "2026-03-01T14:04:30Z")
    assert code == 1
    assert "2 undated pairs dated" in out
    assert "1 left undated: their slots have other rows" in out
    assert woken.store.measurement(slot(126)) == before
    assert len(woken.store.undated()) == 1


def test_rows_of_an_hour_of_a_wrong_clock_are_shifted(station, redate) -> None:
    """An hour ahead for three slots, and nobody noticed but the operator."""
    station.run(2)
    station.clock.advance(3_600)
    station.run(3)
    assert station.minutes() == [0, 1, 61, 62, 63]
    station.clock.advance(7_200)
    span = ["--since", "2026-03-01T13:00", "--until", "2026-03-01T14:00", "--shift", "-3300"]
    code, out, _ = redate(*span)
    assert (code, out) == (0, f"0 undated pairs dated, 3 rows moved\n{AGAIN}")
    assert station.minutes() == [0, 1, 6, 7, 8]
    assert [gap[2] for gap in station.gaps()] == ["crash", "crash", "clock_wrong"]
    moved = [row for row in station.store.measurements() if row.redated_from_utc]
    assert [minute_of(row.redated_from_utc) for row in moved] == [61, 62, 63]


def test_rows_that_others_keep_from_their_slots_are_in_nobodys_way(station, redate) -> None:
    """Of five rows two minutes early the last two find others there, and free their own slots."""
    station.run(7)
    station.clock.advance(3_600)
    span = ["--since", "2026-03-01T12:00", "--until", "2026-03-01T12:05", "--shift", "120"]
    predicted = redate(*span, "--dry-run")[1]
    code, out, _ = redate(*span)
    assert (code, predicted.replace("would be ", "") + AGAIN) == (1, out)
    assert "3 rows moved\n2 left undated" in out
    assert station.minutes() == [2, 3, 4, 5, 6]
    moved = [row for row in station.store.measurements() if row.redated_from_utc]
    assert [minute_of(row.redated_from_utc) for row in moved] == [0, 1, 2]
    assert len(station.store.undated()) == 2


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["--shift", "60"], "name --boot or --since"),
        (["--boot", "boot-2"], "give one of --booted, --shift, --clock-is-right"),
        (["--boot", "boot-9", "--shift", "60"], "no undated pairs"),
        (["--boot", "boot-2", "--clock-is-right"], "for --boot this only"),
        (["--boot", "boot-2", "--booted", "2199-01-01"], "the future"),
        (["--since", "2026-03-01", "--shift", "60"], "give --until and --shift"),
        (["--since", "2020-01-01", "--until", "2020-01-02", "--shift", "60"], "no rows from"),
    ],
)
def test_what_makes_no_sense_is_refused(woken, redate, arguments, problem) -> None:
    code, out, err = redate(*arguments)
    assert (code, out) == (2, "")
    assert problem in err
    assert err.count("\n") == 1
    assert len(woken.store.undated()) == 3
