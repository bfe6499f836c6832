"""`dcam-ctl calibrate` judges its result, stores it, and says what is wrong with its input."""

from __future__ import annotations

import json
import os
import re
import shutil
import sqlite3
from contextlib import closing
from multiprocessing.connection import Connection
from pathlib import Path

import cv2
import numpy as np
import pytest

from daemon.commands import output
from daemon.config.reading import load_config
from daemon.store.database import open_store, open_store_readonly
from drivers.frameset import encode_png, format_slot, read_frame_set, write_table
from drivers.sim.settings import SimSettings
from drivers.sim.world import World
from tests.daemon.commands.conftest import CONFIG, SEED, SMALL, Ctl, edit_table
from tests.daemon.commands.terminals import all_of, program, started_on, terminal
from tests.programs import Program


def calibrate(ctl: Ctl, bench: Path, state: Path, frames: Path, *more: str):
    """Calibrate on a frame set with the bench's config."""
    return ctl(
        *("--config", bench / "dcam.toml", "--state", state, "calibrate", "--from", frames, *more)
    )


@pytest.fixture(scope="session")
def brief(bench: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The frame set with half of its calibration views, for what does not depend on their number.

    Not to be changed.
    """
    made = Path(shutil.copytree(bench / "set", tmp_path_factory.mktemp("brief") / "set"))
    rows = read_frame_set(made)
    lens, rig = rows.rows_of("intrinsics")[:5], rows.rows_of("rig")[:6]
    write_table(made, [*lens, *rows.rows_of("reference"), *rig])
    return made


def test_result_is_reported_stored_and_active(ctl: Ctl, calibrated: Path) -> None:
    """The session's calibration has its report, its hash and its frame set in the database."""
    with open_store_readonly(calibrated) as store:
        record = store.active_calibration()
    assert record is not None
    assert record.report.passed
    assert record.report.lines[0] == "calibration passed"
    assert record.content["method"] == "rigid"
    assert record.frames is not None
    assert Path(record.frames).name == "set"


def test_damaged_lens_and_rig_views_are_left_out_and_named(
    ctl: Ctl, bench: Path, own_set: Path, tmp_path: Path
) -> None:
    """One truncated, one missing, one in colour, one too small: the rest is enough."""
    rows = read_frame_set(own_set)
    lens, rig = rows.rows_of("intrinsics"), rows.rows_of("rig")
    truncated, missing = own_set / str(lens[1].sub), own_set / str(rig[2].main)
    truncated.write_bytes(truncated.read_bytes()[:5000])
    missing.unlink()
    colour, small = own_set / str(rig[4].sub), own_set / str(rig[6].main)
    colour.write_bytes(cv2.imencode(".png", np.zeros((400, 640, 3), np.uint8))[1].tobytes())
    small.write_bytes(encode_png(np.zeros((200, 320), np.uint8)))
    ran = calibrate(ctl, bench, tmp_path / "state", own_set, "--json")
    result = json.loads(ran.out)
    assert ran.code == 0, ran.err
    assert result["schema"] == 1
    assert result["passed"]
    assert result["active"]
    assert result["calibration"] == 1
    assert len(result["left_out"]) == 4
    assert (
        "views used: 7 lens, 1 reference, 9 rig; rejected: 0, could not be read: 4"
        in (result["lines"])
    )
    said = "\n".join(result["lines"])
    for path, reason in (
        (truncated, "truncated"),
        (missing, "not there"),
        (colour, "colour"),
        (small, "320x200"),
    ):
        assert str(path) in said
        assert reason in said


def test_a_slow_run_says_on_a_pipe_that_it_fits_and_for_how_long(
    ctl: Ctl, bench: Path, brief: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(output, "LINE_PERIOD_S", 0.005)
    ran = calibrate(ctl, bench, tmp_path / "state", brief)
    assert ran.code == 0, ran.err
    assert re.search(
        r"^dcam-ctl: fitting lens, board and rig, \d+ s so far$", ran.err, re.MULTILINE
    )


def test_method_paper_on_pan_and_tilt_alone_is_not_made_active(
    ctl: Ctl, bench: Path, brief: Path, tmp_path: Path
) -> None:
    """The nine parameters are not determined: exit code 1, stored, and `--accept` overrides."""
    state = tmp_path / "state"
    ran = calibrate(ctl, bench, state, brief, "--method", "paper")
    assert ran.code == 1
    assert "NOT passed" in ran.out.splitlines()[0]
    assert "not active" in ran.out
    with open_store_readonly(state) as store:
        assert store.active_calibration() is None
        assert len(store.calibrations()) == 1
    accepted = calibrate(ctl, bench, state, brief, "--method", "paper", "--accept")
    assert accepted.code == 0
    assert "did not pass" in accepted.err
    with open_store_readonly(state) as store:
        record = store.active_calibration()
    assert record is not None
    assert record.content["method"] == "paper"


@pytest.mark.parametrize("method", ["rigid", "paper"])
def test_pan_alone_is_refused_and_tilt_is_asked_for(
    ctl: Ctl, bench: Path, brief: Path, tmp_path: Path, method: str
) -> None:
    """Motions that cannot determine the model give no calibration, accepted or not."""
    world = World(load_config(bench / "dcam.toml").site(), SimSettings(seed=SEED))
    own_set = Path(shutil.copytree(brief, tmp_path / "set"))
    rows = read_frame_set(own_set).rows_of("rig")
    for row, pan_deg in zip(rows, np.linspace(-0.15, 0.15, len(rows)), strict=True):
        world.turn_head(float(pan_deg), 0.0)
        (own_set / str(row.main)).write_bytes(encode_png(world.render("main", row.slot_utc)))
        (own_set / str(row.sub)).write_bytes(encode_png(world.render("sub", row.slot_utc)))
    ran = calibrate(ctl, bench, tmp_path / "state", own_set, "--method", method, "--accept")
    assert ran.code == 1
    # A slow run says on a pipe how far it is.
    slow = ("reading views, ", " s so far")
    errors = [line for line in ran.err.splitlines() if not any(word in line for word in slow)]
    assert len(errors) == 1
    assert "missing motion: tilt" in errors[0]
    with open_store_readonly(tmp_path / "state") as store:
        assert store.calibrations() == []


def test_set_without_rig_rows_is_refused(
    ctl: Ctl, bench: Path, own_set: Path, tmp_path: Path
) -> None:
    edit_table(own_set, lambda lines: [line for line in lines if ",rig," not in line])
    ran = calibrate(ctl, bench, tmp_path / "state", own_set)
    assert ran.code == 1
    assert "rig" in ran.err
    assert len(ran.err.splitlines()) == 1


def test_set_of_measure_rows_only_is_refused(
    ctl: Ctl, bench: Path, own_set: Path, tmp_path: Path
) -> None:
    edit_table(own_set, lambda lines: [lines[0], *(line for line in lines if "measure" in line)])
    ran = calibrate(ctl, bench, tmp_path / "state", own_set)
    assert ran.code == 1
    assert "nothing to calibrate on" in ran.err


def test_unreadable_reference_is_an_error_because_there_is_no_zero(
    ctl: Ctl, bench: Path, own_set: Path, tmp_path: Path
) -> None:
    (reference,) = read_frame_set(own_set).rows_of("reference")
    image = own_set / str(reference.main)
    image.write_bytes(b"")
    ran = calibrate(ctl, bench, tmp_path / "state", own_set)
    assert ran.code == 4
    assert f"{image}: an empty file" in ran.err


def test_reference_of_another_size_is_an_error(
    ctl: Ctl, bench: Path, own_set: Path, tmp_path: Path
) -> None:
    (reference,) = read_frame_set(own_set).rows_of("reference")
    (own_set / str(reference.sub)).write_bytes(encode_png(np.zeros((480, 640), np.uint8)))
    ran = calibrate(ctl, bench, tmp_path / "state", own_set)
    assert ran.code == 1
    assert "image is 640x480 px, the config says 640x400" in ran.err


def test_swapped_width_and_height_are_named_with_the_cure(
    ctl: Ctl, bench: Path, own_set: Path, tmp_path: Path
) -> None:
    (reference,) = read_frame_set(own_set).rows_of("reference")
    (own_set / str(reference.sub)).write_bytes(encode_png(np.zeros((640, 400), np.uint8)))
    ran = calibrate(ctl, bench, tmp_path / "state", own_set)
    assert ran.code == 1
    assert "400x640 px, the config says 640x400; they look swapped, exchange width_px" in ran.err


def missing_column(lines: list[str]) -> list[str]:
    return [lines[0].replace("role,", ""), *lines[1:]]


def duplicate_slot(lines: list[str]) -> list[str]:
    return [*lines[:3], lines[2], *lines[3:]]


def two_references(lines: list[str]) -> list[str]:
    return [line.replace(",rig,", ",reference,", 1) if "0010_" in line else line for line in lines]


def out_of_order(lines: list[str]) -> list[str]:
    return [lines[0], lines[2], lines[1], *lines[3:]]


@pytest.mark.parametrize(
    ("damage", "reported"),
    [
        (missing_column, "'role'"),
        (duplicate_slot, "frames.csv:4"),
        (two_references, "reference"),
        (out_of_order, "frames.csv:3"),
    ],
)
def test_damaged_table_is_named_with_what_is_wrong(
    ctl: Ctl, bench: Path, own_set: Path, tmp_path: Path, damage, reported: str
) -> None:
    edit_table(own_set, damage)
    ran = calibrate(ctl, bench, tmp_path / "state", own_set)
    assert ran.code == 4
    assert "frames.csv" in ran.err
    assert reported in ran.err
    assert len(ran.err.splitlines()) == 1
    assert ran.out == ""


def test_missing_directory_is_named(ctl: Ctl, bench: Path, tmp_path: Path) -> None:
    ran = calibrate(ctl, bench, tmp_path / "state", tmp_path / "nowhere")
    assert ran.code == 4
    assert str(tmp_path / "nowhere") in ran.err


def test_squares_of_another_size_in_the_config_are_named(
    ctl: Ctl, brief: Path, tmp_path: Path
) -> None:
    """Not passed, not active: the number that is wrong, what it should be, what to measure."""
    config = tmp_path / "dcam.toml"
    config.write_text(CONFIG.replace("square_mm = 4.0", "square_mm = 6.0"))
    state = tmp_path / "state"
    ran = ctl("--config", config, "--state", state, "calibrate", "--from", brief)
    assert ran.code == 1
    verdict = ran.out.splitlines()[0]
    assert verdict.startswith("calibration NOT passed: ")
    assert "target.sub.square_mm is likely about 4" in verdict
    assert "measure the print: by the config the board's 16 x 15 squares are 96.0 x 90.0" in verdict
    with open_store_readonly(state) as store:
        assert store.active_calibration() is None


def test_unknown_key_gives_the_nearest_name(ctl: Ctl, bench: Path, tmp_path: Path) -> None:
    config = tmp_path / "dcam.toml"
    config.write_text(CONFIG.replace("square_mm", "squares_mm"))
    ran = ctl("--config", config, "calibrate", "--from", bench / "set")
    assert ran.code == 3
    assert "squares_mm" in ran.err
    assert "square_mm" in ran.err


def test_distance_in_metres_is_noticed(ctl: Ctl, bench: Path, tmp_path: Path) -> None:
    config = tmp_path / "dcam.toml"
    config.write_text(CONFIG.replace("distance_mm = 11000.0", "distance_mm = 11.0"))
    ran = ctl("--config", config, "calibrate", "--from", bench / "set")
    assert ran.code == 3
    assert "target.main.distance_mm" in ran.err


def test_database_of_a_newer_version_is_left_alone(ctl: Ctl, bench: Path, tmp_path: Path) -> None:
    """Exit code 5 at once, before the calibration is computed."""
    open_store(tmp_path).close()
    with closing(sqlite3.connect(tmp_path / "dcam.db")) as database, database:
        database.execute("UPDATE alembic_version SET version_num = '9999'")
    ran = calibrate(ctl, bench, tmp_path, bench / "set")
    assert ran.code == 5
    assert "newer" in ran.err
    assert ran.out == ""


@pytest.mark.parametrize("sources", [[], ["--from", "x", "--pan-tilt"]])
def test_one_source_of_views_must_be_named(ctl: Ctl, bench: Path, sources: list[str]) -> None:
    ran = ctl("--config", bench / "dcam.toml", "calibrate", *sources)
    assert ran.code == 2
    assert "give one of --from DIR, --pan-tilt, --intrinsics" in ran.err


def test_pan_tilt_without_a_head_is_a_clear_line(ctl: Ctl, bench: Path, tmp_path: Path) -> None:
    config = tmp_path / "dcam.toml"
    replay = CONFIG.replace("width_px", 'backend = "replay"\nwidth_px')
    config.write_text(f'{replay}\n[replay]\ndirectory = "{bench / "set"}"\n')
    ran = ctl("--config", config, "--state", tmp_path / "state", "calibrate", "--pan-tilt")
    assert ran.code == 4
    assert "no pan-tilt head for backend replay" in ran.err


def test_pan_tilt_takes_views_keeps_them_and_calibrates_on_them(ctl: Ctl, tmp_path: Path) -> None:
    """The simulated head: lens views, the zero, 21 positions and the zero twice again."""
    config, state = tmp_path / "dcam.toml", tmp_path / "state"
    config.write_text(SMALL)
    ran = ctl("--config", config, "--state", state, "calibrate", "--pan-tilt", "--json")
    assert ran.code == 0, ran.err
    result = json.loads(ran.out)
    frames = read_frame_set(Path(result["frames"]))
    assert frames.directory.parent == state / "calibrations"
    assert [len(frames.rows_of(r)) for r in ("intrinsics", "reference", "rig")] == [12, 1, 23]
    assert {(row.pan_deg, row.tilt_deg) for row in frames.rows_of("reference")} == {(0.0, 0.0)}
    assert np.ptp([row.pan_deg for row in frames.rows_of("rig")]) > 0.2
    assert np.ptp([row.tilt_deg for row in frames.rows_of("rig")]) > 0.1
    page = (frames.directory / "report.html").read_text()
    report = json.loads((frames.directory / "report.json").read_text())
    assert report["lines"] == result["lines"]
    assert (frames.directory / "report.txt").read_text().splitlines() == result["lines"]
    assert page.count("<svg") == 3
    assert "http-equiv" not in page
    assert "src=" not in page  # the page stands alone
    for row in frames.rows_of("rig"):
        assert f"rig {format_slot(row.slot_utc)} (" in page
    shutil.copytree(frames.directory, tmp_path / "again")
    again = ctl(
        *("--config", config, "--state", state, "calibrate", "--from", tmp_path / "again"),
        "--json",
    )
    for name in ("sub_rms_px", "main_rms_px", "depth_mm"):
        figure = json.loads(again.out)["figures"][name]
        assert figure == pytest.approx(result["figures"][name], rel=1e-9)


def test_a_reader_that_goes_away_does_not_cost_the_calibration(
    bench: Path, brief: Path, tmp_path: Path
) -> None:
    """`calibrate | head -1`: stdout is closed before the first line of the report."""
    reading, writing = os.pipe()
    os.close(reading)
    script = tmp_path / "at_once.py"
    script.write_text(
        "import io, sys\n"
        "sys.stdout = io.TextIOWrapper(open(1, 'wb', 0), write_through=True)  # as python -u\n"
        "from daemon.ctl import main\n"
        "sys.exit(main())\n"
    )
    words = ("--config", bench / "dcam.toml", "--state", tmp_path / "state")
    with Program(script, *words, "calibrate", "--from", brief, stdout=Connection(writing)):
        pass
    with open_store_readonly(tmp_path / "state") as store:
        assert store.active_calibration() is not None


@pytest.mark.parametrize(("answer", "active"), [("n", False), ("", True)])
def test_on_a_terminal_it_asks(
    bench: Path, brief: Path, tmp_path: Path, answer: str, active: bool
) -> None:
    state = tmp_path / "state"
    words = ("--config", bench / "dcam.toml", "--state", state, "calibrate", "--from", brief)
    ours, its = terminal(80)
    with started_on(its, program(*words), reads=True) as asking:
        os.write(ours, f"{answer}\n".encode())
        shown = all_of(ours)
    assert asking.returncode == 0, shown
    assert "Make it the active calibration?" in shown
    with open_store_readonly(state) as store:
        assert (store.active_calibration() is not None) == active
        assert len(store.calibrations()) == 1
