"""Each kind of alarm that every site has is raised and cleared, under its own name."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from datetime import timedelta

import pytest

from core.results import CalibrationReport
from daemon.config.reading import load_config
from daemon.store.records import CalibrationRecord, GapCause, MeasurementRecord
from tests.daemon.alarm.conftest import WebServer, configure, history, look, row
from tests.daemon.commands.conftest import DARK, MINUTE, START, Site
from tests.daemon.commands.test_further_targets import displacement

DAY = timedelta(days=1)


def fill(site: Site, minutes: int = 30) -> None:
    site.measure(minutes, row(0.0))


def closures(site: Site, value_mm: float, minutes: int) -> None:
    site.measure(minutes, replace(row(0.0), closure=displacement(value_mm, value_mm, 0.25)))


def a_day_later(site: Site) -> None:
    site.end += DAY
    fill(site)


def recalibrate(site: Site) -> None:
    """A calibration that was made just now."""
    record = CalibrationRecord(
        created_utc=site.end,
        content={"method": "rigid"},
        report=CalibrationReport(passed=True, lines=("the verdict",), figures={}),
        config_hash=load_config(site.config).config_hash(),
        version="1.0",
    )
    site.write(lambda store: store.add_calibration(record, activate=True))


def undated(site: Site) -> None:
    record = MeasurementRecord(
        *(START, row(0.0), "0" * 64, "1.0"),
        main_frame="a.png",
        sub_frame="b.png",
        captured_utc=START,
        boot_id="a",
        uptime_s=1.0,
    )
    site.write(lambda store: store.add_undated(record))


def dated(site: Site) -> None:
    with closing(sqlite3.connect(site.state / "dcam.db")) as connection:
        connection.execute("DELETE FROM undated")
        connection.commit()


Step = Callable[[Site], object]

KINDS: dict[str, tuple[Step, Step, str]] = {
    "measurement": (lambda site: None, fill, "ago"),
    "last-good-value": (lambda site: site.measure(5, DARK), fill, "ago"),
    "coverage-24-h": (
        lambda site: site.miss(60, GapCause.STOPPED),
        lambda site: fill(site, 120),
        "% of 70 slots measured",
    ),
    "cameras": (lambda site: site.miss(30, GapCause.CAMERA_LOST), fill, "camera_lost"),
    "closure": (lambda site: closures(site, 0.9, 20), a_day_later, "something came loose"),
    "calibration": (
        lambda site: site.calibrate(config_hash="0" * 64),
        lambda site: site.calibrate(),
        "the config has changed since: calibrate again",
    ),
    "calibration-age": (a_day_later, recalibrate, "more than 0.5 d: calibrate again"),
    "clock": (undated, dated, "dcam-ctl redate"),
}
"""What raises it, what ends it, and words of its message."""


@pytest.mark.parametrize("name", KINDS)
def test_it_is_raised_once_and_cleared(site: Site, web: WebServer, name: str) -> None:
    raise_it, end_it, said = KINDS[name]
    configure(site, f'urls = ["{web.url}"]\nafter_min = 0\ncalibration_age_days = 0.5')
    raise_it(site)
    late = {"measurement": 20 * MINUTE, "last-good-value": 2 * DAY}.get(name, timedelta(0))
    look(site, late)
    look(site, late)
    lines = [line for text in web.texts() for line in text.splitlines()]
    (line,) = [line for line in lines if line.startswith(f"{name}: ")]
    assert " since 2026-" in line
    assert said in line
    site.end += late
    end_it(site)
    look(site)
    cleared = [one["name"] for one in history(site) if one["kind"] == "cleared"]
    assert name in cleared
    assert f"{name}: cleared" in web.texts()[-1]
