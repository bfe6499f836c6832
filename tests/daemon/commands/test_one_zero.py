"""Rows are read in one zero, whatever calibration measured them; what is stored stays."""

from __future__ import annotations

import json
import math
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from core.results import Flag, Measurement
from daemon.store.database import Store, open_store
from daemon.store.records import DatumRecord, MeasurementRecord
from tests.daemon.commands.conftest import GOOD, MINUTE, Site, rows_of
from tests.daemon.store.examples import calibration, datum

X_MM, Y_MM, SIGMA_MM = 0.337, 2.75, 0.02


def recalibrate(site: Site, link: DatumRecord | None = None) -> None:
    """A second calibration; the next rows are measured with it."""

    def change(store: Store) -> None:
        store.add_calibration(calibration(), link or datum(X_MM, Y_MM, SIGMA_MM), activate=True)

    site.write(change)


def measure(site: Site, calibration_id: int, measurement: Measurement = GOOD) -> None:
    row = MeasurementRecord(site.end, measurement, "hash", "1.0", calibration_id=calibration_id)
    site.write(lambda store: store.add_measurement(row))
    site.end += MINUTE


def test_an_export_is_what_is_stored_with_the_datum_added(site: Site, tmp_path: Path) -> None:
    measure(site, 1)
    recalibrate(site)
    measure(site, 2)
    assert site.ctl("export", "--output", tmp_path / "a.csv").code == 0
    *_, first, second = rows_of(tmp_path / "a.csv")
    for prefix, (x_mm, y_mm) in {"": (0.5, -1.25), "raw_": (7.0, 9.0)}.items():
        assert float(first[f"{prefix}x_mm"]) == x_mm
        assert float(second[f"{prefix}x_mm"]) == pytest.approx(x_mm + X_MM)
        assert float(second[f"{prefix}y_mm"]) == pytest.approx(y_mm + Y_MM)
        sigma_mm = math.hypot(0.2, SIGMA_MM)
        assert float(second[f"{prefix}sigma_y_mm"]) == pytest.approx(sigma_mm, abs=1e-6)
    assert second["rx_rad"] == first["rx_rad"]
    with open_store(site.state) as store:
        assert store.measurement(site.end - MINUTE).measurement.corrected.mm.tolist() == [
            0.5,
            -1.25,
        ]


def test_status_metrics_and_figures_speak_in_the_same_zero(site: Site, tmp_path: Path) -> None:
    recalibrate(site)
    measure(site, 2)
    last = json.loads(site.status().out)["last"]
    assert (last["x_mm"], last["y_mm"]) == pytest.approx((0.5 + X_MM, -1.25 + Y_MM))
    assert last["sigma_x_mm"] == pytest.approx(math.hypot(0.1, SIGMA_MM))
    said = site.ctl("metrics").out
    assert f'dcam_displacement_metres{{axis="y"}} {(-1.25 + Y_MM) * 1e-3!r}'[:45] in said
    assert site.ctl("report", "--output", tmp_path / "a.html").code == 0
    assert f"{-1.25 + Y_MM:.2f}" in (tmp_path / "a.html").read_text()


def test_the_newest_link_of_a_calibration_holds(site: Site) -> None:
    recalibrate(site, datum(9.0, 9.0))
    site.write(lambda store: store.add_datums({2: datum(X_MM, Y_MM, SIGMA_MM)}))
    measure(site, 2)
    assert json.loads(site.status().out)["last"]["x_mm"] == pytest.approx(0.5 + X_MM)
    with open_store(site.state) as store:
        assert [link.offset.mm.tolist() for link in store.datum_links()] == [[9, 9], [X_MM, Y_MM]]


def test_a_withheld_value_stays_empty(site: Site, tmp_path: Path) -> None:
    recalibrate(site)
    raw_only = Measurement(Flag.BAD, (), None, GOOD.raw, None)
    measure(site, 2, raw_only)
    assert site.ctl("export", "--output", tmp_path / "a.csv").code == 0
    last = rows_of(tmp_path / "a.csv")[-1]
    assert (last["x_mm"], last["sigma_x_mm"]) == ("", "")
    assert float(last["raw_x_mm"]) == pytest.approx(7.0 + X_MM)


def test_a_flipped_datum_is_an_error_and_no_value(site: Site) -> None:
    recalibrate(site)
    measure(site, 2)
    with closing(sqlite3.connect(site.state / "dcam.db")) as connection, connection:
        connection.execute("DROP TRIGGER datum_no_update")
        connection.execute("UPDATE datum SET y_mm = 3.75")
    ran = site.ctl("export")
    assert ran.code == 5
    assert "a row of datum, id 1, is not what was written" in ran.err


def test_a_moved_row_keeps_its_stored_value(site: Site) -> None:
    """`redate` reads rows to write them again: the datum must not be added to what is stored."""
    recalibrate(site)
    measure(site, 2)
    with open_store(site.state) as store:
        *_, last = store.measurements()
        assert last.measurement.corrected.mm.tolist() == [0.5, -1.25]
