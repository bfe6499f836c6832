"""Further targets of a record: what `status`, `alarm`, `metrics` and `export` say of them."""

from __future__ import annotations

import csv
import io
import json
import sqlite3
import sys
from contextlib import closing
from dataclasses import replace
from datetime import timedelta
from typing import Any

import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from core.results import Displacement, Flag, Measurement, Reason, TargetMeasurement
from core.site import TargetRole
from daemon.lock import sole_writer
from tests.daemon.commands.conftest import DARK, GOOD, MINUTE, Ran, Site


def displacement(x_mm: float, y_mm: float, sigma_mm: float) -> Displacement:
    return Displacement(np.array([x_mm, y_mm]), np.eye(2) * sigma_mm**2)


CLOSURE = displacement(0.3, -0.4, 0.25)
FIXED = TargetMeasurement(
    "abutment", TargetRole.FIXED, Flag.GOOD, (), CLOSURE, displacement(3.0, 4.0, 0.01)
)
MEASURED = TargetMeasurement(
    "span-2",
    TargetRole.MEASURED,
    Flag.GOOD,
    (),
    displacement(1.5, -2.5, 0.02),
    displacement(4.0, 1.0, 0.01),
)
BOTH = replace(GOOD, closure=CLOSURE, targets=(FIXED, MEASURED))


def hidden(target: TargetMeasurement, reason: Reason = Reason.TARGET_NOT_FOUND) -> Any:
    """What is said of a target that is not there."""
    return replace(target, flag=Flag.BAD, reasons=(reason,), corrected=None, raw=None)


def lost(*targets: TargetMeasurement) -> Measurement:
    """A good row without its fixed target."""
    return replace(GOOD, targets=targets)


def texts(ran: Ran) -> dict[str, str]:
    return {item["name"]: item["text"] for item in json.loads(ran.out)["items"]}


def test_status_gives_the_closure_and_each_target(site: Site) -> None:
    """The rms of x and y over 30 days, beside what the sigmas say it should be."""
    site.measure(20, BOTH)
    ran = site.status()
    assert ran.code == 0, ran.out
    said, document = texts(ran), json.loads(ran.out)
    assert said["closure"] == "0.35 mm over 30 d, sigma 0.25"
    assert said["target abutment"] == "fixed, x +0.300 ± 0.250 mm, y -0.400 ± 0.250 mm"
    assert said["target span-2"] == "measured, x +1.500 ± 0.020 mm, y -2.500 ± 0.020 mm"
    assert document["closure_30d"]["rms_mm"] == pytest.approx(0.125**0.5)
    assert document["closure_30d"]["sigma_mm"] == pytest.approx(0.25)
    assert document["closure_24h"]["rows"] == 20
    fixed, measured = document["targets"]
    assert (fixed["name"], fixed["role"], fixed["flag"], fixed["reasons"]) == (
        *("abutment", "fixed", 1),
        [],
    )
    assert (measured["x_mm"], measured["raw_x_mm"]) == (1.5, 4.0)
    assert [target["name"] for target in document["last"]["targets"]] == ["abutment", "span-2"]
    assert document["last"]["closure_x_mm"] == 0.3


def test_closures_of_a_month_count_and_older_ones_do_not(site: Site) -> None:
    site.measure(5, replace(BOTH, closure=displacement(9.0, 9.0, 0.25)))
    site.end += timedelta(days=31)
    site.measure(1, replace(BOTH, closure=displacement(0.2, 0.2, 0.25)))
    site.end += timedelta(days=3)
    site.measure(1, replace(BOTH, closure=displacement(0.4, 0.4, 0.25)))
    document = json.loads(site.status().out)
    assert document["closure_30d"]["rows"] == 2
    assert document["closure_30d"]["rms_mm"] == pytest.approx(0.1**0.5)
    assert document["closure_24h"]["rms_mm"] == pytest.approx(0.4)


def test_a_closure_far_beyond_its_sigma_is_a_warning(site: Site) -> None:
    site.measure(3, BOTH)
    site.measure(30, replace(BOTH, closure=displacement(0.9, -0.9, 0.25)))
    ran = site.status()
    assert site.levels(ran)["closure"] == "warning"
    assert "something came loose" in texts(ran)["closure"]


def test_a_target_hidden_for_a_while_is_said_and_no_alarm(site: Site) -> None:
    site.measure(20, BOTH)
    site.measure(30, lost(hidden(FIXED), MEASURED))
    ran = site.status()
    assert site.levels(ran)["target abutment"] == "ok"
    assert texts(ran)["target abutment"] == (
        "fixed, no value (bad: target_not_found), last value 30 min 30 s ago"
    )
    assert json.loads(ran.out)["targets"][0]["rows_with_value_24h"] == 20


def test_a_target_lost_for_a_day_is_a_warning(site: Site) -> None:
    """Of the rows that have a value: a day of darkness says nothing of it."""
    site.measure(1, BOTH)
    site.end += timedelta(hours=24)
    site.measure(9, lost(hidden(FIXED), MEASURED))
    site.measure(9, replace(DARK, targets=(hidden(FIXED), hidden(MEASURED))))
    assert site.levels(site.status())["target abutment"] == "ok"
    site.measure(1, lost(hidden(FIXED), MEASURED))
    ran = site.status()
    assert site.levels(ran)["target abutment"] == "warning"
    assert "no value in 24 h, in none of 10 rows" in texts(ran)["target abutment"]
    assert site.levels(ran)["target span-2"] == "ok"


@pytest.mark.parametrize(
    ("reason", "todo"),
    [
        (Reason.FIXED_TARGET_MOVED, "fasten it, then calibrate again"),
        (Reason.TARGET_NOT_CALIBRATED, "calibrate again with it in view"),
    ],
)
def test_what_is_to_be_done_about_a_target_is_said(site: Site, reason: Reason, todo: str) -> None:
    moved = replace(FIXED, flag=Flag.SUSPECT, reasons=(reason,))
    site.measure(2, lost(moved, MEASURED))
    ran = site.status()
    assert site.levels(ran)["target abutment"] == "warning"
    assert f"(suspect: {reason}): {todo}" in texts(ran)["target abutment"]


def test_the_targets_are_those_of_the_newest_rows(site: Site) -> None:
    """One that the config no longer has is no alarm; a row without images changes nothing."""
    site.measure(15, lost(hidden(replace(FIXED, name="old-pier")), MEASURED))
    site.measure(2, lost(MEASURED))
    site.measure(1, Measurement(Flag.MISSING, (Reason.MAIN_IMAGE_MISSING,), None, None, None))
    named = [item for item in texts(site.status()) if item.startswith("target")]
    assert named == ["target span-2"]


def test_an_alarm_is_raised_for_a_lost_target(site: Site, tmp_path: Any) -> None:
    site.measure(20, lost(hidden(FIXED), MEASURED))
    inbox = tmp_path / "inbox"
    program = tmp_path / "modem.py"
    program.write_text(f"import sys; open({str(inbox)!r}, 'a').write(sys.stdin.read())\n")
    command = json.dumps([sys.executable, str(program)])
    site.config.write_text(
        f'{site.config.read_text()}\n[alarm]\nlevel = "warning"\nafter_min = 0\ncommand = {command}'
    )
    with sole_writer(site.state):
        ran = site.ctl("alarm", "--at", (site.end - MINUTE / 2).isoformat())
    assert ran.code == 0, ran.err
    assert "target-abutment: warning since" in inbox.read_text()


def test_prometheus_is_given_each_target_by_its_name(site: Site) -> None:
    site.measure(2, replace(DARK, targets=(FIXED, MEASURED)))  # says nothing of the share
    site.measure(3, BOTH)
    site.measure(1, lost(FIXED, hidden(MEASURED)))
    with sole_writer(site.state):
        ran = site.ctl("metrics", "--at", (site.end - MINUTE / 2).isoformat())
    found = {
        (sample.name.removeprefix("dcam_"), *sorted(sample.labels.values())): sample.value
        for family in text_string_to_metric_families(ran.out)
        for sample in family.samples
    }
    assert found["target_flag", "abutment"] == 1
    assert found["target_flag", "span-2"] == 4
    assert found["target_displacement_metres", "abutment", "y"] == pytest.approx(-0.0004)
    assert found["target_displacement_sigma_metres", "abutment", "x"] == pytest.approx(0.00025)
    assert ("target_displacement_metres", "span-2", "x") not in found
    assert found["target_value_ratio", "span-2"] == pytest.approx(3 / 4)
    assert found["closure_rms_metres", "30d"] == pytest.approx(0.125**0.5 / 1000)
    assert found["closure_sigma_metres", "24h"] == pytest.approx(0.00025)


def test_an_export_has_each_target(site: Site) -> None:
    site.measure(1, BOTH)
    rows = list(csv.DictReader(io.StringIO(site.ctl("export").out)))
    assert rows[0]["abutment_x_mm"] == ""
    assert (rows[-1]["abutment_x_mm"], rows[-1]["span-2_raw_y_mm"]) == ("0.3", "1.0")


def test_damage_to_what_a_row_says_of_targets_is_named(site: Site) -> None:
    """Where the row is shown; what counts rows goes on without it."""
    site.measure(3, BOTH)
    with closing(sqlite3.connect(site.state / "dcam.db")) as connection:
        connection.execute("UPDATE measurement SET targets = '[{\"na' WHERE id = 12")
        connection.commit()
    assert json.loads(site.status().out)["targets"][0]["rows_24h"] == 2
    ran = site.ctl("export")
    assert ran.code == 5
    assert "slot_utc 2026-03-01T00:11:00Z" in ran.err


def test_a_site_without_further_targets_says_nothing_of_any(site: Site) -> None:
    status, export, metrics = site.ctl("status").out, site.ctl("export").out, site.ctl("metrics")
    assert "closure" not in status
    assert "target" not in status
    assert [name for name in export.splitlines()[0].split(",") if "closure" in name] == [
        *("closure_x_mm", "closure_y_mm"),
        *("closure_sigma_x_mm", "closure_sigma_y_mm", "closure_cov_xy_mm2"),
    ]
    assert "abutment" not in export
    assert "closure" not in metrics.out
    assert "target" not in metrics.out
    document = json.loads(site.status().out)
    assert (document["closure_30d"], document["targets"]) == (None, [])
