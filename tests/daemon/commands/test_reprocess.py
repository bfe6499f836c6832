"""`dcam-ctl reprocess` gives one line a pair, in order, whatever the images show."""

from __future__ import annotations

import csv
import io
import json
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest

from core.results import Flag, Measurement, Reason
from daemon.store.database import open_store, open_store_readonly
from daemon.store.frames.archive import FrameArchive
from daemon.store.records import MeasurementRecord
from drivers.frameset import encode_png, read_frame_set
from drivers.protocols import CapturedFrame, CapturedPair
from tests.daemon.commands.conftest import CONFIG, Ctl, edit_table, rows_of

COLUMNS = (
    "slot_utc,flag,reasons,x_mm,y_mm,sigma_x_mm,sigma_y_mm,raw_x_mm,raw_y_mm,"
    "rx_rad,ry_rad,rz_rad,tx_mm,ty_mm,tz_mm,"
    "sigma_image_x_mm,sigma_image_y_mm,closure_x_mm,closure_y_mm"
)


@pytest.fixture
def reprocess(ctl: Ctl, bench: Path, calibrated: Path, tmp_path: Path):
    """`reprocess --from` a directory with the session's calibration; gives what ran and rows."""

    def ran(frames: Path, *more: object):
        output = tmp_path / "out.csv"
        result = ctl(
            *("--config", bench / "dcam.toml", "--state", calibrated, "reprocess"),
            *("--from", frames, "--output", output, *more),
        )
        assert result.code == 0, result.err
        return result, rows_of(output)

    return ran


def test_every_measure_row_is_answered_in_order_and_near_the_truth(reprocess, bench: Path) -> None:
    """Corrected values are within 0.3 mm on this coarse sensor; the raw ones are not."""
    _, rows = reprocess(bench / "set")
    truth = [row for row in rows_of(bench / "set" / "truth.csv") if row["role"] == "measure"]
    assert [row["slot_utc"] for row in rows] == [row["slot_utc"] for row in truth]
    raw_error_mm = []
    for row, true in zip(rows, truth, strict=True):
        for axis in "xy":
            true_mm = float(true[f"{axis}_mm"])
            assert abs(float(row[f"{axis}_mm"]) - true_mm) < 0.3
            assert 0.0 < float(row[f"sigma_{axis}_mm"]) < 0.3
            raw_error_mm.append(abs(float(row[f"raw_{axis}_mm"]) - true_mm))
        for name in ("rx_rad", "ry_rad", "rz_rad"):
            assert abs(float(row[name]) - float(true[name])) < 5e-5
    assert max(raw_error_mm) > 3.0


def test_the_columns_are_those_that_scripts_rely_on(reprocess, bench: Path, tmp_path: Path) -> None:
    reprocess(bench / "set")
    assert (tmp_path / "out.csv").read_text().splitlines()[0] == COLUMNS


def colour(image: Path) -> None:
    image.write_bytes(cv2.imencode(".png", np.zeros((400, 640, 3), np.uint8))[1].tobytes())


def truncate(image: Path) -> None:
    image.write_bytes(image.read_bytes()[:-2000])


def empty(image: Path) -> None:
    image.write_bytes(b"")


def wrong_size(image: Path) -> None:
    image.write_bytes(encode_png(np.full((400, 641), 99, np.uint8)))


def remove(image: Path) -> None:
    image.unlink()


@pytest.mark.parametrize("role", ["main", "sub"])
@pytest.mark.parametrize(
    ("damage", "flag", "reason", "reported"),
    [
        (colour, "4", "image_unreadable", "colour"),
        (truncate, "4", "image_unreadable", "truncated"),
        (empty, "4", "image_unreadable", "empty"),
        (wrong_size, "4", "image_wrong_size", "is 641x400 px, the config says 640x400"),
        (remove, "9", "image_missing", "not there"),
    ],
)
def test_a_damaged_image_is_a_row_with_its_reason(
    reprocess, own_set: Path, role: str, damage, flag: str, reason: str, reported: str
) -> None:
    """Only its own row is touched, the value is withheld, and stderr says what is wrong."""
    frames = read_frame_set(own_set).rows_of("measure")
    image = own_set / str(getattr(frames[1], role))
    damage(image)
    ran, rows = reprocess(own_set)
    assert len(rows) == len(frames)
    assert rows[1]["flag"] == flag
    assert f"{role}_{reason}" in rows[1]["reasons"].split("+")
    assert rows[1]["x_mm"] == rows[1]["y_mm"] == rows[1]["sigma_x_mm"] == ""
    assert reported in ran.err
    assert image.name in ran.err
    assert all(row["flag"] in {"1", "3"} for k, row in enumerate(rows) if k != 1)


def test_a_row_that_names_no_image_is_missing(reprocess, own_set: Path) -> None:
    (first, *_) = read_frame_set(own_set).rows_of("measure")
    edit_table(own_set, lambda lines: [line.replace(str(first.main), "") for line in lines])
    _, rows = reprocess(own_set)
    assert rows[0]["flag"] == "9"
    assert "main_image_missing" in rows[0]["reasons"]


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_an_image_without_a_target_is_withheld(reprocess, own_set: Path, grey: int) -> None:
    (first, *_) = read_frame_set(own_set).rows_of("measure")
    (own_set / str(first.main)).write_bytes(encode_png(np.full((400, 640), grey, np.uint8)))
    _, rows = reprocess(own_set)
    assert rows[0]["flag"] == "4"
    assert rows[0]["reasons"]
    assert rows[0]["x_mm"] == ""


def test_table_goes_to_stdout_by_default_and_nothing_else_does(
    ctl: Ctl, bench: Path, calibrated: Path
) -> None:
    ran = ctl(
        *("--config", bench / "dcam.toml", "--state", calibrated),
        *("reprocess", "--from", bench / "set"),
    )
    assert ran.out.splitlines()[0] == COLUMNS
    assert len(list(csv.DictReader(io.StringIO(ran.out)))) == 4
    assert "4 rows with calibration 1" in ran.err


def test_json_has_a_schema_and_the_same_names(reprocess, bench: Path) -> None:
    ran, rows = reprocess(bench / "set", "--json")
    document = json.loads(ran.out)
    assert document["schema"] == 1
    assert document["calibration"] == 1
    bursts = ["spread_x_mm", "spread_y_mm", "frames_used"]
    assert list(document["rows"][0]) == [*COLUMNS.split(","), *bursts, "targets"]
    given, written = ([row["x_mm"] for row in table] for table in (document["rows"], rows))
    assert [float(x_mm) for x_mm in written] == pytest.approx(given, rel=0, abs=0.51e-6)


def test_nothing_is_written_to_the_database(reprocess, bench: Path, calibrated: Path) -> None:
    before = (calibrated / "dcam.db").read_bytes()
    reprocess(bench / "set")
    assert (calibrated / "dcam.db").read_bytes() == before


@pytest.mark.parametrize("more", [[], ["--calibration", "7"]])
def test_without_a_calibration_it_says_how_to_get_one(
    ctl: Ctl, bench: Path, tmp_path: Path, more: list[str]
) -> None:
    open_store(tmp_path / "state").close()
    ran = ctl(
        *("--config", bench / "dcam.toml", "--state", tmp_path / "state"),
        *("reprocess", "--from", bench / "set", *more),
    )
    assert ran.code == 1
    assert "run dcam-ctl calibrate" in ran.err
    assert len(ran.err.splitlines()) == 1


def test_a_calibration_that_is_not_there_is_reported_with_those_that_are(
    ctl: Ctl, bench: Path, calibrated: Path
) -> None:
    ran = ctl(
        *("--config", bench / "dcam.toml", "--state", calibrated),
        *("reprocess", "--from", bench / "set", "--calibration", "99"),
    )
    assert ran.code == 1
    assert "no calibration 99; those known are 1: choose one" in ran.err


def test_without_a_database_it_says_the_same(ctl: Ctl, bench: Path, tmp_path: Path) -> None:
    ran = ctl(
        *("--config", bench / "dcam.toml", "--state", tmp_path / "state"),
        *("reprocess", "--from", bench / "set"),
    )
    assert ran.code == 1
    assert "run dcam-ctl calibrate" in ran.err


def test_a_config_that_changed_since_the_calibration_is_warned_of(
    ctl: Ctl, bench: Path, calibrated: Path, tmp_path: Path
) -> None:
    config = tmp_path / "dcam.toml"
    config.write_text(CONFIG.replace("distance_sigma_mm = 20.0", "distance_sigma_mm = 30.0"))
    ran = ctl(
        *("--config", config, "--state", calibrated, "reprocess", "--from", bench / "set"),
    )
    assert ran.code == 0
    assert "the config has changed since calibration 1" in ran.err


def test_set_without_measure_rows_is_reported(
    ctl: Ctl, bench: Path, calibrated: Path, own_set: Path
) -> None:
    edit_table(own_set, lambda lines: [line for line in lines if "measure" not in line])
    ran = ctl(
        *("--config", bench / "dcam.toml", "--state", calibrated, "reprocess", "--from", own_set),
    )
    assert ran.code == 1
    assert "no frames to measure" in ran.err


def test_span_does_not_go_with_a_frame_set(ctl: Ctl, bench: Path, calibrated: Path) -> None:
    ran = ctl(
        *("--config", bench / "dcam.toml", "--state", calibrated),
        *("reprocess", "--from", bench / "set", "--since", "24h"),
    )
    assert ran.code == 2


def test_kept_frames_are_measured_again_and_the_rows_stay(
    ctl: Ctl, bench: Path, calibrated: Path, tmp_path: Path
) -> None:
    """Frames of the archive in a span give the values of the same images in a frame set."""
    state = Path(shutil.copytree(calibrated, tmp_path / "state"))
    start = datetime(2026, 3, 1, tzinfo=UTC)
    frames = read_frame_set(bench / "set")
    archive = FrameArchive(state)
    for k, row in enumerate(frames.rows_of("measure")):
        main, sub = (frames.read(str(name)) for name in (row.main, row.sub))
        pair = CapturedPair(
            CapturedFrame(main.pixels, 8, k, 0, 0.0), CapturedFrame(sub.pixels, 8, k, 0, 0.0), 0.001
        )
        archive.store(start + timedelta(minutes=k), pair)
    blank = Measurement(Flag.BAD, (Reason.TOO_DARK,), None, None, None)
    with open_store(state) as store:
        store.add_measurement(MeasurementRecord(start, blank, "", ""))
    damaged = state / "frames/2026/03/01/000200_sub.png"
    damaged.write_bytes(damaged.read_bytes()[:100])
    arguments = ("--config", bench / "dcam.toml", "--state", state, "reprocess", "--json")
    kept = json.loads(ctl(*arguments, "--since", "2026-03-01", "--until", "2026-03-01T00:03Z").out)
    fresh = json.loads(ctl(*arguments, "--from", bench / "set").out)
    slots = [row["slot_utc"] for row in kept["rows"]]
    assert slots == [f"2026-03-01T00:0{k}:00Z" for k in range(3)]
    for name in ("x_mm", "y_mm", "sigma_image_x_mm", "flag"):  # sigma_x_mm grows with the age
        assert [row[name] for row in kept["rows"][:2]] == [row[name] for row in fresh["rows"][:2]]
    assert kept["rows"][2]["flag"] == 4
    assert "sub_image_unreadable" in kept["rows"][2]["reasons"]
    with open_store_readonly(state) as store:
        assert [row.measurement.flag for row in store.measurements()] == [Flag.BAD]
