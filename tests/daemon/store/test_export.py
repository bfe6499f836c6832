"""CSV: the agreed columns first, all digits, line by line, whole files only."""

from __future__ import annotations

import csv
import io
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from core.results import Flag, Measurement, Reason
from daemon.reports.table import opened_output, write_records, write_results
from daemon.store.records import MeasurementRecord
from tests.daemon.store.examples import BAD, full_measurement, full_record, record, slot

AGREED = (
    "slot_utc,flag,reasons,x_mm,y_mm,sigma_x_mm,sigma_y_mm,raw_x_mm,raw_y_mm,"
    "rx_rad,ry_rad,rz_rad,tx_mm,ty_mm,tz_mm"
)


def written(records: list[MeasurementRecord]) -> list[dict[str, str]]:
    output = io.StringIO()
    assert write_records(records, output) == len(records)
    return list(csv.DictReader(io.StringIO(output.getvalue())))


def test_results_have_the_agreed_columns_and_empty_fields_for_what_is_not_known() -> None:
    output = io.StringIO()
    count = write_results([(slot(0), full_measurement()), (slot(1), BAD)], output)
    assert count == 2
    assert output.getvalue() == (
        f"{AGREED}\n"
        "2026-03-01T00:00:00Z,3,too_dark+main_target_partly_hidden,0.1,-0.2,0.2,0.3,1.1,-1.2,"
        "0.001,-0.002,0.003,0.1,-0.2,0.3\n"
        "2026-03-01T00:01:00Z,4,main_target_not_found,,,,,,,,,,,,\n"
    )


def test_a_missing_frame_is_a_row_too() -> None:
    missing = Measurement(Flag.MISSING, (Reason.MAIN_IMAGE_MISSING,), None, None, None)
    output = io.StringIO()
    write_results([(slot(0), missing)], output)
    assert output.getvalue().splitlines()[1] == (
        "2026-03-01T00:00:00Z,9,main_image_missing,,,,,,,,,,,,"
    )


def test_records_have_the_agreed_columns_first_and_then_everything_else() -> None:
    output = io.StringIO()
    write_records([], output)
    header = output.getvalue().strip()
    assert header.startswith(AGREED + ",")
    (row,) = written([full_record(slot(0), calibration_id=7)])
    assert row["captured_utc"] == "2026-03-01T00:00:00.001234Z"
    assert row["main_frame"] == "frames/2026/03/01/000000_main.png"
    assert (row["calibration_id"], row["config_hash"], row["version"]) == ("7", "c0ffee", "0.1.0")
    assert (row["recorded_late"], row["skew_s"]) == ("true", "-0.0012")
    assert row["redated_from_utc"] == "2023-09-13T00:00:00Z"
    assert (row["uptime_s"], row["clock_synchronised"]) == ("86400.25", "false")
    assert (row["main_temperature_c"], row["sub_exposure_us"]) == ("41.5", "800.25")
    assert (row["discs_found"], row["raw_cov_xy_mm2"]) == ("5", "-0.02")
    assert all(value != "" for value in row.values())
    (bad,) = written([record(slot(0))])
    assert (bad["x_mm"], bad["calibration_id"], bad["skew_s"]) == ("", "", "")


def test_rows_are_written_as_they_come(tmp_path: Path) -> None:
    """Years of rows never stand in memory together."""
    output = io.StringIO()

    def rows() -> Iterator[MeasurementRecord]:
        for number in range(3):
            assert output.getvalue().count("\n") == number + 1
            yield record(slot(number))

    assert write_records(rows(), output) == 3


def test_a_file_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "out.csv"
    target.write_text("an older export")

    def rows() -> Iterator[MeasurementRecord]:
        yield record(slot(0))
        assert target.read_text() == "an older export"
        msg = "half way"
        raise RuntimeError(msg)

    with pytest.raises(RuntimeError, match="half way"), opened_output(target) as output:
        write_records(rows(), output)
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]
    assert target.read_text() == "an older export"
    with opened_output(target) as output:
        write_records([record(slot(0))], output)
    assert target.read_text().startswith(AGREED)
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "link.csv").symlink_to(tmp_path / "out.csv")
    with opened_output(tmp_path / "link.csv") as output:
        output.write("text")
    assert (tmp_path / "link.csv").is_symlink()
    assert (tmp_path / "out.csv").read_text() == "text"


def test_no_path_is_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    with opened_output(None) as output:
        write_results([], output)
    assert capsys.readouterr().out == AGREED + "\n"


def test_a_pipe_is_written_to_and_stays_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    received: list[str] = []
    reader = threading.Thread(target=lambda: received.append(pipe.read_text()))
    reader.start()
    with opened_output(pipe) as output:
        write_results([], output)
    reader.join(timeout=10.0)
    assert received == [AGREED + "\n"]
    assert pipe.is_fifo()
