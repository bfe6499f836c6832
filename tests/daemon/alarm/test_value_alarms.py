"""Alarms on the value reach people by mail and web: raised within the dwell time, and cleared."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest

from core.results import Displacement, Flag, Reason, TargetMeasurement
from core.site import TargetRole
from daemon.store.ledger.entries import LedgerEntry, LedgerKind
from daemon.store.records import CameraState, Reading
from tests.daemon.alarm.conftest import (
    LOW,
    MailServer,
    Program,
    WebServer,
    configure,
    history,
    listed,
    look,
    row,
)
from tests.daemon.commands.conftest import Site


def test_a_level_crossing_is_mailed_within_the_dwell_time_and_so_is_its_end(
    site: Site, mail: MailServer, web: WebServer
) -> None:
    """1 mm beyond the level, which is 9 sigma of a row: raised after 3 of 5 minutes."""
    configure(site, f'urls = ["{mail.url}", "{web.url}"]\n{LOW}')
    minutes = 0
    while not web.messages:
        site.measure(1, row(-11.0, 0.11))
        minutes += 1
        ran = look(site)
        assert ran.code == 0, ran.err
        assert minutes <= 5
    assert minutes == 3
    (mailed,) = mail.mails
    assert mailed["subject"] == "dcam bench: CRITICAL"
    body = mailed.get_body(("plain",))
    assert body is not None
    for said in (body.get_content(), *web.texts()):
        flat = " ".join(said.split())
        assert "midspan-low: critical since 2026-03-01T00:12:20Z" in flat
        assert "main y -11.000 ± 0.110 mm, below -10 mm by more than noise explains" in flat
        assert "look at the two images of the slot" in flat
        assert "dcam-ctl alarm ack midspan-low" in flat
    site.measure(3, row(-9.95))  # inside, but not by the hysteresis
    look(site)
    assert len(web.messages) == 1
    site.measure(3, row(-9.5))
    look(site)
    assert web.titles()[1:] == ["dcam bench: all well again"]
    assert "midspan-low: cleared, 2026-03-01T00:18:20Z" in web.texts()[1]
    assert [str(one["subject"]) for one in mail.mails] == web.titles()
    assert [one["kind"] for one in history(site)] == [
        *("raised", "sent", "sent"),
        *("cleared", "sent", "sent"),
    ]


def test_noise_hidden_rows_and_single_rows_raise_nothing(site: Site, program: Program) -> None:
    configure(site, f"command = {program.command}\n{LOW}")
    site.measure(8, row(-11.0, 0.4))  # not beyond by 3 sigma
    look(site)
    suspect = row(-50.0, 0.1, Flag.SUSPECT, Reason.MAIN_TARGET_PARTLY_HIDDEN)
    site.measure(8, suspect)
    look(site)
    site.measure(2, row(-50.0))
    site.measure(3, row(-1.0))
    look(site)
    assert program.messages() == []


def test_what_moves_faster_than_the_bridge_can_is_an_alarm_all_the_same(
    site: Site, program: Program
) -> None:
    configure(site, f"command = {program.command}\n{LOW}")
    site.measure(5, row(-50.0, 0.1, Flag.SUSPECT, Reason.CAMERA_BUMPED))
    look(site)
    (message,) = program.messages()
    assert "5 of them suspect (camera_bumped" in message


def test_what_the_ledger_excludes_raises_nothing(site: Site, program: Program) -> None:
    configure(site, f"command = {program.command}\n{LOW}")
    begin = site.end
    site.measure(8, row(-50.0))
    painted = LedgerEntry(LedgerKind.EXCLUDE, "eve", begin, "paint", begin, site.end)
    site.write(lambda store: store.add_ledger_entry(painted) and None)
    look(site)
    assert program.messages() == []
    undo = LedgerEntry(LedgerKind.UNDO, "eve", site.end, "it was real", entry_id=1)
    site.write(lambda store: store.add_ledger_entry(undo) and None)
    look(site)
    assert program.titles() == ["dcam bench: CRITICAL"]


def test_a_gap_neither_clears_nor_raises(site: Site, program: Program) -> None:
    configure(site, f"command = {program.command}\n{LOW}")
    site.measure(5, row(-11.0))
    look(site)
    look(site, late=timedelta(minutes=9))
    site.end += timedelta(minutes=30)
    site.measure(2, row(-1.0))
    look(site)
    assert program.titles() == ["dcam bench: CRITICAL"]
    assert listed(site)["midspan-low"]["state"] == "raised"


EXTRA = """
[[target.extra]]
name = "span-2"
role = "measured"
kind = "circles"
centres_mm = [[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]]
diameter_mm = 8.0
distance_mm = 21500.0
distance_sigma_mm = 20.0
"""


def test_a_further_target_has_its_own_alarm(site: Site, program: Program) -> None:
    alarm = f'command = {program.command}\n{LOW}target = "span-2"\naxis = "x"'
    configure(site, alarm.replace("below_mm = -10.0", "above_mm = 4.0"), EXTRA)
    value = Displacement(np.array([5.0, 0.0]), np.eye(2) * 0.01)
    target = TargetMeasurement("span-2", TargetRole.MEASURED, Flag.GOOD, (), value, value)
    site.measure(4, replace(row(0.0), targets=(target,)))
    look(site)
    (message,) = program.messages()
    assert "span-2 x +5.000 ± 0.100 mm, above +4 mm" in message


def test_a_rate_is_raised_and_cleared(site: Site, program: Program) -> None:
    """1 mm in 12 hours, while the level is far away; then it stands still."""
    rate = '[[alarm.rate]]\nname = "sinks"\nlimit_mm_per_day = 1.0\nwindow_h = 12\n'
    configure(site, f"command = {program.command}\n{rate}")
    quarter = timedelta(minutes=15)
    for step in range(52):
        site.measure(1, row(-step / 48))
        site.end += quarter - timedelta(minutes=1)
    site.end += timedelta(minutes=1) - quarter
    look(site)
    (message,) = program.messages()
    assert "sinks: critical since" in message
    assert "mm/d over 12 h, faster than 1 mm/d" in message
    assert "main y -2.0" in message
    for _ in range(52):
        site.end += quarter - timedelta(minutes=1)
        site.measure(1, row(-52 / 48))
    look(site)
    assert "sinks: cleared" in program.messages()[1]


@pytest.mark.parametrize(("reading", "kind"), [("temperature-main", "camera"), ("deck", "sensor")])
def test_a_temperature_is_raised_and_cleared(
    site: Site, program: Program, reading: str, kind: str
) -> None:
    alarm = f'[[alarm.reading]]\nname = "hot"\nreading = "{reading}"\nabove = 60.0\n'
    sensor = '[[reading]]\nname = "deck"\nunit = "degC"\nfile = "/dev/null"\n'
    configure(site, f"command = {program.command}\n{alarm}", sensor)

    def measure(minutes: int, value_c: float) -> None:
        cameras = {"main_camera": CameraState(temperature_c=value_c)}
        readings = {"readings": (Reading("deck", "degC", value_c),)}
        site.measure(minutes, row(0.0), **(cameras if kind == "camera" else readings))

    measure(20, 65.5)
    look(site)
    measure(20, 59.5)  # within the hysteresis
    look(site)
    (message,) = program.messages()
    assert "hot: warning since" in message
    assert f"{reading} 65.5, above 60 over 15 min" in message
    measure(20, 58.0)
    look(site)
    assert "hot: cleared" in program.messages()[1]
