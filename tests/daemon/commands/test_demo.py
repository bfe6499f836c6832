"""`dcam-ctl demo` runs the whole system and ends with the error against the truth and a figure."""

from __future__ import annotations

import importlib.util
import json
import math
import sqlite3
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from core.results import Displacement, Flag, Measurement, Reason, RigMotion
from daemon.commands import demo, demo_season
from daemon.config.reading import load_config
from daemon.reports.figure import GapSpan, draw
from daemon.reports.series import series_of
from daemon.store.integrity.checksum import row_digest
from drivers.sim.season_writer import SeasonPlan
from tests.daemon.commands.conftest import Ctl
from tests.programs import Forked

PNG = b"\x89PNG\r\n\x1a\n"
SMALLER = (
    *(("1920", "480"), ("1200\npixel", "300\npixel"), ("5.86", "23.44")),
    *(("squares_x = 32", "squares_x = 16"), ("squares_y = 31", "squares_y = 15")),
    ("square_mm = 2.0", "square_mm = 4.0"),
)


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The demo's site on sensors of a quarter of the pixels, for its first 24 slots.

    Its board has a quarter of the squares, and its season fewer views to calibrate on, so that a
    calibration takes a third of the time.
    """
    text = demo.SITE.read_text()
    for whole, part in SMALLER:
        assert whole in text
        text = text.replace(whole, part)
    site = tmp_path / "small.toml"
    site.write_text(text)
    monkeypatch.setattr(demo, "SITE", site)
    monkeypatch.setattr(demo, "subprocess", Forked)
    monkeypatch.setattr(demo, "SLOTS", 24)
    plan = SeasonPlan(demo_season.DAYS, (8,), intrinsics=8, rig=12)
    monkeypatch.setattr(demo_season, "season_plan", lambda *_, **__: plan)
    return tmp_path / "demo"


def test_the_demo_site_is_a_valid_config_with_the_whole_story() -> None:
    config = load_config(demo.SITE)
    kinds = {scenario.kind for scenario in config.simulation.scenarios}
    assert {"drift", "bridge", "night", "camera_loss", "insect_main", "insect_sub"} <= kinds
    assert demo.SLOTS >= 60
    assert demo.SLOTS * config.schedule.period_s == 86400


def test_the_demo_calibrates_runs_and_compares_with_the_truth(ctl: Ctl, small: Path) -> None:
    """Status, coverage, gaps with causes, errors and a figure; a second run replaces the first."""
    ran = ctl("demo", "--output", small)
    assert ran.code == 0, ran.err
    assert "calibration passed" in ran.out
    assert "DCAM " in ran.out
    assert "Coverage: " in ran.out
    assert "camera_lost" in ran.out
    (gaps,) = (line for line in ran.out.splitlines() if line.startswith("1 gap,"))
    assert gaps == "1 gap, 5 slots missed"
    table = {
        line.split("  ")[0]: line.split()[-2:]
        for line in ran.out.splitlines()
        if line.startswith(("raw ", "corrected "))
    }
    assert float(table["raw"][0]) > 3.0
    assert float(table["corrected"][0]) < 0.5
    assert (small / "demo.png").read_bytes().startswith(PNG)
    _assert_the_season_is_told(ran.out, small)
    assert "event=stopped" in (small / "dcamd.log").read_text()
    status = ctl("--config", small / "dcam.toml", "status", "--json", "--at", "2026-03-01T14:00Z")
    assert json.loads(status.out)["coverage_24h"]["unaccounted"] == 0
    _assert_rows_can_be_made_once_more(ctl, small)


def _assert_rows_can_be_made_once_more(ctl: Ctl, directory: Path) -> None:
    """From their frames to the last bit; a row that somebody wrote with its checksum is noticed.

    Unless it says that other numerics made it: then the difference is no finding, but told.
    """
    verify = ("--config", directory / "dcam.toml", "verify", "--rebuild", "100")
    ran = ctl(*verify)
    assert ran.code == 0, ran.out
    assert "\n19 rows made once more from their frames" in ran.out
    assert "other numerics" not in ran.out
    with closing(sqlite3.connect(directory / "state" / "dcam.db")) as connection:
        connection.row_factory = sqlite3.Row
        query = "SELECT * FROM measurement WHERE y_mm IS NOT NULL LIMIT 1"
        row = dict(connection.execute(query).fetchone())
        _write(connection, row | {"y_mm": math.nextafter(row["y_mm"], math.inf)})
        ran = ctl(*verify)
        assert ran.code == 1
        assert f"row: {row['slot_utc']}: made from its frames once more it differs in y_mm" in (
            ran.out
        )
        hour_back = row["slot_utc"].replace("T0", "T1")
        assert hour_back != row["slot_utc"]
        _write(connection, row | {"y_mm": row["y_mm"] + 1e-3, "redated_from_utc": hour_back})
        ran = ctl(*verify)
        assert ran.code == 0, ran.out
        assert "\n18 rows made once more from their frames" in ran.out
        assert "\n1 row that a wrong clock had dated" in ran.out
        assert "1 come out otherwise now, by 0.001 mm at most\n" in ran.out
        _write(connection, row | {"y_mm": row["y_mm"] + 0.25, "version": "0.1.0+0badc0de"})
        ran = ctl(*verify)
        assert ran.code == 0, ran.out
        assert "\n18 rows made once more from their frames" in ran.out
        assert "\n1 row of other numerics" in ran.out
        assert "1 come out otherwise now, by 0.25 mm at most\n" in ran.out


def _write(connection: sqlite3.Connection, row: dict[str, object]) -> None:
    """Change a row past the program, with its checksum."""
    row["digest"] = row_digest("measurement", row)
    change = (
        "UPDATE measurement SET y_mm = :y_mm, version = :version, digest = :digest, "
        "redated_from_utc = :redated_from_utc WHERE id = :id"
    )
    connection.execute(change, row)
    connection.commit()


def _assert_the_season_is_told(out: str, directory: Path) -> None:
    """Steel that bends costs tenths of a millimetre without a fixed target, and none with it."""
    rms_mm = {
        line.split(" a fixed target")[0]: float(line.split("target")[1].split()[2])
        for line in out.splitlines()
        if line.startswith(("without a fixed target ", "with a fixed target "))
    }
    assert rms_mm["without"] > 0.3
    assert rms_mm["with"] < 0.02
    assert (directory / "season.png").read_bytes().startswith(PNG)


def test_a_directory_with_something_else_in_it_is_left_alone(ctl: Ctl, tmp_path: Path) -> None:
    (tmp_path / "state").mkdir()
    (tmp_path / "dcam.toml").write_text("# the config of a real site")
    ran = ctl("demo", "--output", tmp_path)
    assert ran.code == 2
    assert "holds something else" in ran.err
    assert (tmp_path / "state").is_dir()


def test_an_earlier_demo_is_replaced(tmp_path: Path) -> None:
    demo.prepared(tmp_path / "demo")
    left_over = tmp_path / "demo" / "state" / "dcam.db"
    left_over.parent.mkdir()
    left_over.touch()
    demo.prepared(tmp_path / "demo")
    assert not left_over.exists()


def test_without_matplotlib_it_says_how_to_install_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    assert not demo.can_draw()
    assert "no figure: matplotlib is not installed; " in capsys.readouterr().err


@pytest.mark.parametrize(("suffix", "known"), [("png", True), ("svg", False)])
def test_figure_is_drawn_with_and_without_truth(tmp_path: Path, suffix: str, known: bool) -> None:
    """Every flag, rows without motion, and a gap at the very end."""
    start = datetime(2026, 3, 1, tzinfo=UTC)
    shift = Displacement(np.array([1.0, 2.0]), np.eye(2) * 0.01)
    motion = RigMotion(np.zeros(3), np.zeros(3), np.eye(6))
    rows = [
        Measurement(Flag.GOOD, (), shift, shift, motion),
        Measurement(Flag.SUSPECT, (Reason.BLURRED,), shift, shift, motion),
        Measurement(Flag.BAD, (Reason.TOO_DARK,), None, None, None),
        Measurement(Flag.MISSING, (Reason.MAIN_IMAGE_MISSING,), None, None, motion),
    ]
    timed = [(start + timedelta(minutes=k), row) for k, row in enumerate(rows)]
    series = series_of(timed, np.zeros((4, 2)) if known else None)
    end = start + timedelta(minutes=4)
    path = tmp_path / f"figure.{suffix}"
    draw(series, [GapSpan(end, end + timedelta(minutes=2), "crash")], "title", path)
    assert path.stat().st_size > 10_000
