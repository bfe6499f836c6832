"""CSV: the agreed columns first, digits that mean something, whole files only."""

from __future__ import annotations

import csv
import io
import os
import threading
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from core.results import Displacement, Flag, Measurement, Reason, RigMotion
from daemon.commands.output_files import opened_table
from daemon.reports.slot_table import COLUMNS as EXPORTED
from daemon.reports.slot_table import kind_of_column, slot_table
from daemon.reports.table import DECIMALS, write_results, write_slots
from daemon.store.database import ALWAYS, NEVER, open_store
from daemon.store.records import MeasurementRecord
from tests.daemon.store.examples import (
    BAD,
    FIXED,
    HIDDEN,
    MEASURED,
    calibration,
    full_measurement,
    full_record,
    record,
    slot,
)
from tests.waiting import PATIENCE_S

AGREED = (
    "slot_utc,flag,reasons,x_mm,y_mm,sigma_x_mm,sigma_y_mm,raw_x_mm,raw_y_mm,"
    "rx_rad,ry_rad,rz_rad,tx_mm,ty_mm,tz_mm"
)
APPENDED = "sigma_image_x_mm,sigma_image_y_mm,closure_x_mm,closure_y_mm"


def written(tmp_path: Path, records: list[MeasurementRecord]) -> list[dict[str, str]]:
    """The records as a store gives them back to `export`."""
    output = io.StringIO()
    with open_store(tmp_path) as store:
        if any(record.calibration_id for record in records):
            store.add_calibration(calibration())
        for record in records:
            store.add_measurement(record)
        slots = slot_table(store, ALWAYS, NEVER, lambda _done, _total: None)
        assert write_slots(slots, output) == len(records)
    return list(csv.DictReader(io.StringIO(output.getvalue())))


def test_results_have_the_agreed_columns_and_empty_fields_for_what_is_not_known() -> None:
    output = io.StringIO()
    count = write_results([(slot(0), full_measurement()), (slot(1), BAD)], output)
    assert count == 2
    assert output.getvalue() == (
        f"{AGREED},{APPENDED}\n"
        "2026-03-01T00:00:00Z,3,too_dark+main_target_partly_hidden,0.1,-0.2,0.2,0.3,1.1,-1.2,"
        "0.001,-0.002,0.003,0.1,-0.2,0.3,0.05,0.06,0.03,-0.04\n"
        "2026-03-01T00:01:00Z,4,main_target_not_found,,,,,,,,,,,,,,,,\n"
    )


def test_results_have_columns_for_each_further_target_of_the_config() -> None:
    """In the config's order, whatever the rows say of them; those of bursts come last."""
    hidden = replace(BAD, targets=(HIDDEN,))
    rows = [(slot(0), full_measurement()), (slot(1), hidden), (slot(2), BAD)]
    output = io.StringIO()
    write_results(rows, output, targets=["quarter-span", "abutment"], bursts=True)
    header, full, without, nothing = (line.split(",") for line in output.getvalue().splitlines())
    start = len(f"{AGREED},{APPENDED}".split(","))
    assert ",".join(header[start:]) == (
        "quarter-span_flag,quarter-span_x_mm,quarter-span_y_mm,"
        "quarter-span_sigma_x_mm,quarter-span_sigma_y_mm,"
        "abutment_flag,abutment_x_mm,abutment_y_mm,abutment_sigma_x_mm,abutment_sigma_y_mm,"
        "spread_x_mm,spread_y_mm,frames_used"
    )
    assert ",".join(full[start:]) == "3,0.7,-0.8,0.6,0.7,1,0.03,-0.04,0.1,0.15,0.05,0.06,5"
    assert without[start:] == [*[""] * 5, "4", *[""] * 6, "0"]
    assert nothing[start:] == [*[""] * 12, "0"]


def test_without_a_stability_budget_the_image_gives_the_whole_sigma() -> None:
    shift = Displacement(np.zeros(2), np.diag([0.04, 0.09]))
    output = io.StringIO()
    write_results([(slot(0), Measurement(Flag.GOOD, (), shift, None, None))], output)
    (row,) = csv.DictReader(io.StringIO(output.getvalue()))
    assert (row["sigma_image_x_mm"], row["sigma_image_y_mm"]) == ("0.2", "0.3")
    assert row["sigma_x_mm"] == "0.2"


def test_a_missing_frame_is_a_row_too() -> None:
    missing = Measurement(Flag.MISSING, (Reason.MAIN_IMAGE_MISSING,), None, None, None)
    output = io.StringIO()
    write_results([(slot(0), missing)], output)
    assert output.getvalue().splitlines()[1] == (
        "2026-03-01T00:00:00Z,9,main_image_missing,,,,,,,,,,,,,,,,"
    )


def test_numbers_have_the_digits_that_mean_something() -> None:
    """A millionth of a millimetre, a billionth of a radian; no zero has a sign."""
    covariance = np.eye(2) * (1.0 / 3.0)
    shift = Displacement(np.array([1.0 / 3.0, -1e-12]), covariance)
    motion = RigMotion(np.array([1e-4 / 3.0, 0.0, 0.0]), np.array([2.0 / 3.0, 0, 0]), np.eye(6))
    output = io.StringIO()
    write_results([(slot(0), Measurement(Flag.GOOD, (), shift, None, motion))], output)
    assert output.getvalue().splitlines()[1] == (
        "2026-03-01T00:00:00Z,1,,0.333333,0.0,0.57735,0.57735,,,3.3333e-05,0.0,0.0,0.666667,0.0,0.0"
        ",0.57735,0.57735,,"
    )


def test_every_number_of_the_database_has_its_digits() -> None:
    reals = {name.rpartition("_")[2] for name in EXPORTED if kind_of_column(name) == "real"}
    assert reals == set(DECIMALS)


def test_slots_have_the_agreed_columns_first_and_then_everything_else(tmp_path: Path) -> None:
    row, bad = written(tmp_path, [full_record(slot(0), calibration_id=1), record(slot(1))])
    assert ",".join(row).startswith(AGREED + ",")
    assert row["captured_utc"] == "2026-03-01T00:00:00.001234Z"
    assert row["main_frame"] == "frames/2026/03/01/000000_main.png"
    assert (row["calibration_id"], row["config_hash"], row["version"]) == ("1", "c0ffee", "0.1.0")
    assert (row["recorded_late"], row["skew_s"]) == ("true", "-0.0012")
    assert row["redated_from_utc"] == "2023-09-13T00:00:00Z"
    assert (row["uptime_s"], row["clock_synchronised"]) == ("86400.25", "false")
    assert (row["main_temperature_c"], row["sub_exposure_us"]) == ("41.5", "800.25")
    assert (row["discs_found"], row["raw_cov_xy_mm2"]) == ("5", "-0.02")
    assert (row["sigma_image_y_mm"], row["closure_cov_xy_mm2"]) == ("0.06", "0.002")
    assert [name for name, value in row.items() if not value] == [
        # The closure of a fixed target is the sum of what there is: it has no image's share here.
        *("abutment_reasons", "abutment_sigma_image_x_mm", "abutment_sigma_image_y_mm"),
        *("abutment_cov_image_xy_mm2", "reading_air", "excluded", "detail"),
    ]
    assert (bad["x_mm"], bad["calibration_id"], bad["skew_s"]) == ("", "", "")


def test_slots_have_columns_of_the_targets_that_the_rows_name(tmp_path: Path) -> None:
    """Those of the newest row first; the config may have named others before."""
    pier = replace(MEASURED, name="old-pier")
    rows = [
        record(slot(0), replace(BAD, targets=(pier, HIDDEN))),
        record(slot(1)),
        record(slot(2), replace(BAD, targets=(MEASURED, FIXED))),
    ]
    first, without, last = written(tmp_path, rows)
    flags = [name for name in first if name.endswith("_flag")]
    assert flags == ["quarter-span_flag", "abutment_flag", "old-pier_flag"]
    assert list(first)[-1] == "detail"
    assert (first["abutment_flag"], first["abutment_x_mm"]) == ("4", "")
    assert first["abutment_reasons"] == "target_not_found"
    assert (first["old-pier_flag"], first["old-pier_raw_y_mm"]) == ("3", "-5.5")
    assert {name: without[name] for name in flags} == dict.fromkeys(flags, "")
    assert (last["abutment_role"], last["quarter-span_role"]) == ("fixed", "measured")
    assert last["quarter-span_reasons"] == "target_partly_hidden+target_disturbed"
    assert (last["quarter-span_sigma_x_mm"], last["quarter-span_sigma_image_x_mm"]) == (
        "0.6",
        "0.02",
    )
    assert last["old-pier_flag"] == ""


def test_a_record_without_further_targets_has_no_columns_of_any(tmp_path: Path) -> None:
    (row,) = written(tmp_path, [record(slot(0))])
    assert tuple(row) == EXPORTED


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "out.csv"
    target.write_text("an older export")

    def rows() -> Iterator[tuple[datetime, Measurement]]:
        yield slot(0), BAD
        assert target.read_text() == "an older export"
        msg = "half way"
        raise RuntimeError(msg)

    with pytest.raises(RuntimeError, match="half way"), opened_table(target) as output:
        write_results(rows(), output)
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]
    assert target.read_text() == "an older export"
    with opened_table(target) as output:
        write_results([(slot(0), BAD)], output)
    assert target.read_text().startswith(AGREED)
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "link.csv").symlink_to(tmp_path / "out.csv")
    with opened_table(tmp_path / "link.csv") as output:
        output.write("text")
    assert (tmp_path / "link.csv").is_symlink()
    assert (tmp_path / "out.csv").read_text() == "text"


def test_no_path_is_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    with opened_table(None) as output:
        write_results([], output)
    assert capsys.readouterr().out == f"{AGREED},{APPENDED}\n"


def test_a_pipe_is_written_to_and_stays_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    received: list[str] = []
    reader = threading.Thread(target=lambda: received.append(pipe.read_text()))
    reader.start()
    with opened_table(pipe) as output:
        write_results([], output)
    reader.join(timeout=PATIENCE_S)
    assert received == [f"{AGREED},{APPENDED}\n"]
    assert pipe.is_fifo()
