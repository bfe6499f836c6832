"""`dcam-ctl analyse`: what a record of eight days says, or in one line why it says nothing."""

from __future__ import annotations

import csv
import importlib.util
import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest

from benchmarks.bridges import BEGIN_S, DAY_S, Bridge, Made, make, write_record
from daemon.analysis.days import days_of
from tests.daemon.commands.conftest import DARK, SIMULATED, Ctl, Ran, Site
from tests.shared import shared_directory

BRIDGE = Bridge(days=8.0, step_day=5.0, step_mm=-6.5)
Analyse = Callable[..., Ran]


def thinned(made: Made, every: int) -> Made:
    """Fewer rows, as of a longer period."""
    return Made(*(column[::every] for column in (made.times_s, made.y_mm, made.deck_c)))


@pytest.fixture(scope="module")
def week(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state with a row every five minutes, and its config."""

    def fill(directory: Path) -> None:
        (directory / "dcam.toml").write_text(SIMULATED + "\n[schedule]\nperiod_s = 300\n")
        write_record(directory / "state", thinned(make(replace(BRIDGE, lost=0.0), 4), 5))

    return shared_directory(tmp_path_factory, "week", fill)


@pytest.fixture
def analyse(week: Path, ctl: Ctl) -> Analyse:
    def run(*arguments: object) -> Ran:
        where = ("--config", week / "dcam.toml", "--state", week / "state")
        return ctl(*where, "analyse", *arguments)

    return run


def rows_of(state: Path) -> list[tuple[object, ...]]:
    with closing(sqlite3.connect(state / "dcam.db")) as connection:
        return connection.execute("SELECT * FROM measurement ORDER BY id").fetchall()


def test_the_numbers_are_those_of_the_bridge_and_no_row_is_changed(
    analyse: Analyse, week: Path
) -> None:
    before = rows_of(week / "state")
    ran = analyse("--json", "--before-after", "2026-03-06T00:00:00Z")
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    assert (found["point"], found["axis"]) == ("main", "y")
    (deck,) = found["temperature"]["readings"]
    assert (deck["name"], deck["unit"], deck["kind"]) == ("deck", "degC", "shift")
    assert deck["mm_per_unit"]["value"] == pytest.approx(0.25, abs=0.03)
    assert deck["lag_h"]["low"] - 0.1 <= 2.0 <= deck["lag_h"]["high"] + 0.1
    (step,) = found["steps"]["found"]
    assert step["mm"]["value"] == pytest.approx(-6.5, abs=0.1)
    assert step["earliest_utc"] <= "2026-03-06T00:00:00Z" <= step["latest_utc"]
    (event,) = found["before_after"]
    assert event["mm"]["low"] <= -6.5 <= event["mm"]["high"]
    assert event["mm"]["high"] - event["mm"]["low"] < 0.5
    assert found["drift"] is None
    assert found["notes"] == ["drift: needs 30 days"]
    assert rows_of(week / "state") == before


def test_people_read_days_of_their_own_clock_and_sentences(analyse: Analyse) -> None:
    ran = analyse("--tz", "Asia/Seoul", "--since", "2026-03-02T00:00:00Z")
    assert ran.code == 0, ran.err
    lines = ran.out.splitlines()
    assert " ".join(lines[0].split()) == "main y min mm mean mm max mm rows complete"
    assert lines[1].startswith("2026-03-02 ")  # 15 hours of it
    assert lines[8].startswith("2026-03-09 ")
    assert "mm/K" in ran.out
    assert "below 1.5 years it may be part of a season" in ran.out
    assert "step -6.5" in ran.out
    assert "+09:00" in next(line for line in lines if line.startswith("step"))


def test_a_day_of_the_clock_change_has_23_hours() -> None:
    zone = ZoneInfo("Europe/Berlin")
    span = (datetime(2026, 3, 28, 23, tzinfo=UTC), datetime(2026, 3, 29, 22, tzinfo=UTC))
    times_s = np.arange(span[0].timestamp(), span[1].timestamp(), 60.0)
    values_mm = np.linspace(-1.0, 1.0, len(times_s))
    values_mm[:138] = np.nan
    (day,) = days_of(times_s, values_mm, zone, 60.0, span)
    assert day.day.isoformat() == "2026-03-29"
    assert day.rows == 23 * 60 - 138
    assert day.completeness == pytest.approx(0.9)
    assert day.highest_mm == 1.0


def test_the_table_of_days_and_the_figure_are_files(analyse: Analyse, tmp_path: Path) -> None:
    table, figure = tmp_path / "days.csv", tmp_path / "week.png"
    assert analyse("--output", table).code == 0
    with table.open(newline="") as file:
        days = list(csv.DictReader(file))
    made = thinned(make(replace(BRIDGE, lost=0.0), 4), 5)
    first = made.y_mm[made.times_s < BEGIN_S + DAY_S]
    assert len(days) == 8
    assert (days[0]["day"], days[0]["rows"]) == ("2026-03-01", str(len(first)))
    assert float(days[0]["min_mm"]) == pytest.approx(first.min(), abs=1e-4)
    assert float(days[0]["mean_mm"]) == pytest.approx(first.mean(), abs=1e-4)
    assert float(days[0]["max_mm"]) == pytest.approx(first.max(), abs=1e-4)
    assert float(days[0]["completeness"]) == pytest.approx(len(first) / 288.0, abs=1e-4)
    assert analyse("--output", figure).code == 0
    assert figure.read_bytes().startswith(b"\x89PNG")


def test_what_the_ledger_excludes_is_left_out_and_counted(ctl: Ctl, tmp_path: Path) -> None:
    config, state = tmp_path / "dcam.toml", tmp_path / "state"
    config.write_text(SIMULATED + "\n[schedule]\nperiod_s = 300\n")
    site = ("--config", config, "--state", state)
    made = thinned(make(Bridge(days=2.0, lost=0.0), 4), 5)
    hour_s = BEGIN_S + 10.0 * 3600.0
    inside = (made.times_s >= hour_s) & (made.times_s < hour_s + 3600.0)
    write_record(state, replace(made, y_mm=np.where(inside, 9.0, made.y_mm)))
    first_day = made.times_s < BEGIN_S + DAY_S
    usual = made.y_mm[first_day & ~inside].max()
    span = ("--since", "2026-03-01T10:00Z", "--until", "2026-03-01T11:00Z")
    later = ("--since", "2027-03-01T10:00Z", "--until", "2027-03-01T11:00Z")
    for when in (span, later):
        ran = ctl(*site, "ledger", "exclude", *when, "--by", "Eve", "scaffold moved")
        assert ran.code == 0, ran.err

    def analysed(*arguments: str) -> Ran:
        ran = ctl(*site, "analyse", *arguments)
        assert ran.code == 0, ran.err
        return ran

    without, taken_in = json.loads(analysed("--json").out), analysed("--json", "--with-excluded")
    assert without["days"][0]["max_mm"] == pytest.approx(usual, abs=1e-4)
    assert without["excluded"] == {"rows": inside.sum(), "spans": 1, "left_out": True}
    assert without["days"][0]["rows"] == (first_day & ~inside).sum()
    everything = json.loads(taken_in.out)
    assert everything["days"][0]["max_mm"] == pytest.approx(9.0, abs=1e-4)
    assert everything["excluded"] == {"rows": inside.sum(), "spans": 1, "left_out": False}
    said = f"quality ledger: {inside.sum()} good rows in 1 excluded span "
    assert f"{said}left out\n" in analysed().out
    assert f"{said}taken in\n" in analysed("--with-excluded").out


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("--point", "pylon"), 2, "no measured point of this name in the span; there are: main"),
        (("--reading", "sun"), 2, "there are: main-camera, sub-camera, deck"),
        (("--output", "a.pdf"), 2, "name a file that ends in .png, .svg or .csv"),
        (("--since", "2027-01-01"), 1, "no slots in this span; there are slots from 2026-03-01"),
    ],
)
def test_a_mistake_is_one_line(
    analyse: Analyse, arguments: tuple[str, str], code: int, words: str
) -> None:
    ran = analyse(*arguments)
    assert (ran.code, ran.out) == (code, "")
    assert words in ran.err.splitlines()[-1]


def test_a_figure_without_its_library_names_the_extra(
    analyse: Analyse, monkeypatch: pytest.MonkeyPatch
) -> None:
    there = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "matplotlib" else there(name)
    )
    ran = analyse("--output", "a.png")
    assert ran.code != 0
    assert "no figure: matplotlib is not installed; " in ran.err.splitlines()[-1]


def test_a_record_of_minutes_gives_its_day_and_says_what_it_is_too_short_for(site: Site) -> None:
    site.measure(5, DARK)
    ran = site.ctl("analyse", "--json")
    assert ran.code == 0, ran.err
    found = json.loads(ran.out)
    (day,) = found["days"]
    assert (day["rows"], day["mean_mm"]) == (10, -1.25)
    assert day["completeness"] == pytest.approx(10.0 / 15.0, abs=0.05)
    assert found["trend"] is None
    assert "need 5" in found["notes"][0]
