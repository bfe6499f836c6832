"""`plot`, `report` and the file formats of `export`, of rows with and without value and a gap."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from core.results import Displacement, Flag, Measurement
from daemon.reports import history
from daemon.reports.series import BINS
from daemon.store.database import open_store
from daemon.store.records import GapCause
from tests.daemon.commands.conftest import SIMULATED, Ctl
from tests.daemon.rows import add_rows
from tests.daemon.store.examples import (
    BAD,
    FIXED,
    calibration,
    full_measurement,
    full_record,
    record,
    slot,
)


@pytest.fixture
def site(ctl: Ctl, tmp_path: Path):
    """Rows 0 to 9, a gap of five slots, rows 15 to 19 without a value."""
    (tmp_path / "dcam.toml").write_text(SIMULATED, encoding="utf-8")
    with open_store(tmp_path / "state") as store:
        number = store.add_calibration(calibration(), activate=True)
        for minute in range(10):
            store.add_measurement(full_record(slot(minute), calibration_id=number))
        store.record_gap(slot(10), slot(14), GapCause.POWER_LOSS, "<the plug>", period_s=60)
        for minute in range(15, 20):
            store.add_measurement(record(slot(minute)))
    paths = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
    return lambda *arguments: ctl(*arguments, *paths)


def test_plot_draws_png_and_svg(site, tmp_path: Path) -> None:
    ran = site("plot", "--output", tmp_path / "a.png")
    assert (ran.code, ran.out) == (0, "")
    assert "75.0% of 20 slots measured" in ran.err
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert site("plot", "--output", tmp_path / "a.svg").code == 0
    assert ET.parse(tmp_path / "a.svg").getroot().tag.endswith("svg")


@pytest.mark.parametrize("rows", [9, 12])
def test_plot_draws_the_closure_and_the_measured_targets(
    ctl: Ctl, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rows: int
) -> None:
    """Whether every row is a point or, of many, their envelope; without them there is neither."""
    monkeypatch.setattr(history, "MOST_POINTS", 10)
    for name, measurement in (
        ("further", full_measurement()),
        ("none", replace(full_measurement(), closure=None, targets=())),
    ):
        (tmp_path / f"{name}.toml").write_text(SIMULATED, encoding="utf-8")
        with open_store(tmp_path / name) as store:
            for minute in range(rows):
                store.add_measurement(record(slot(minute), measurement))
        paths = ("--config", tmp_path / f"{name}.toml", "--state", tmp_path / name)
        assert ctl("plot", "--output", tmp_path / f"{name}.svg", *paths).code == 0
    drawn, without = ((tmp_path / f"{name}.svg").read_text() for name in ("further", "none"))
    words = ("<!-- closure (mm) -->", "<!-- closure y -->", "<!-- quarter-span -->")
    assert [drawn.count(word) for word in words] == [1, 1, 2]  # a measured one in x and in y
    assert "<!-- abutment -->" not in drawn
    assert [without.count(word) for word in words] == [0, 0, 0]


def test_report_is_one_file_that_tells_everything(site, tmp_path: Path) -> None:
    ran = site("report", "--output", tmp_path / "a.html")
    assert ran.code == 0
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    for fact in (
        "Slots from 2026-03-01T00:00:00Z until 2026-03-01T00:19:01Z",
        "75.0% of 20 slots measured: 10 suspect, 5 bad, 5 in gaps",
        "power_loss",
        "&lt;the plug&gt;",
        "main_target_partly_hidden",
        "Good to 0.05 mm.",
        "data:image/svg+xml;base64,",
        "<td>measured</td>",
        "quarter-span</td>",
        "closure x, y, rms",
        '<td class="n">0.030, 0.040</td><td class="n">0.100, 0.150</td>',
    ):
        assert fact in page
    assert "http://" not in page
    assert "https://" not in page


def test_a_report_counts_the_good_rows_of_each_further_target(ctl: Ctl, tmp_path: Path) -> None:
    (tmp_path / "dcam.toml").write_text(SIMULATED, encoding="utf-8")
    suspect = replace(FIXED, flag=Flag.SUSPECT)
    with open_store(tmp_path / "state") as store:
        store.add_calibration(calibration(), activate=True)
        for minute, target in enumerate((FIXED, FIXED, suspect)):
            store.add_measurement(record(slot(minute), replace(BAD, targets=(target,))))
    paths = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
    assert ctl("report", "--output", tmp_path / "a.html", *paths).code == 0
    page = (tmp_path / "a.html").read_text(encoding="utf-8")
    line = page[page.index("abutment</td>") :].partition("</tr>")[0]
    cells = re.findall(r"<td[^>]*>(.*?)</td>", line)
    pair = "+0.030, -0.040"
    assert cells == ["fixed", "3", "2", pair, pair, pair, "0.100, 0.150"]
    assert "closure x, y" not in page


@pytest.mark.parametrize(("command", "name"), [("plot", "a.png"), ("report", "a.html")])
def test_a_span_without_slots_says_which_there_are(
    site, tmp_path: Path, command: str, name: str
) -> None:
    ran = site(command, "--since", "2030-01-01", "--output", tmp_path / name)
    assert (ran.code, ran.out) == (1, "")
    assert "there are slots from 2026-03-01T00:00:00Z to 2026-03-01T00:19:00Z" in ran.err
    assert not (tmp_path / name).exists()


def test_plot_to_another_kind_of_file_is_a_usage_error(site, tmp_path: Path) -> None:
    ran = site("plot", "--output", tmp_path / "a.pdf")
    assert ran.code == 2
    assert "ends in .png or .svg" in ran.err


@pytest.mark.parametrize("file_format", ["parquet", "netcdf"])
def test_a_binary_table_needs_a_file(site, file_format: str) -> None:
    ran = site("export", "--format", file_format)
    assert (ran.code, ran.out) == (2, "")
    assert "give --output FILE" in ran.err


def test_a_peak_of_one_row_of_a_long_record_is_drawn_as_high_as_it_is_and_where_it_is(
    ctl: Ctl, tmp_path: Path
) -> None:
    """Of 17 rows to a column of the picture, which lie at -1 and 1 mm, one is at 9 mm."""
    rows, peak, peak_mm = 20_000, 13_370, 9.0
    (tmp_path / "dcam.toml").write_text(SIMULATED, encoding="utf-8")
    low, high, highest = (record(slot(0), moved_to(y_mm)) for y_mm in (-1.0, 1.0, peak_mm))
    with open_store(tmp_path / "state") as store:
        add_rows(
            store,
            (
                replace(highest if k == peak else high if k % 2 else low, slot_utc=slot(k))
                for k in range(rows)
            ),
        )
    paths = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
    assert ctl("plot", "--output", tmp_path / "a.svg", *paths).code == 0
    right, down = corrected_line(tmp_path / "a.svg")
    at_top = down < down.min() + 0.1
    low_at, high_at = down.max(), down[~at_top].min()
    assert (low_at - down.min()) / (low_at - high_at) == pytest.approx(
        (peak_mm + 1.0) / 2.0, rel=0.01
    )
    places = (right[at_top] - right.min()) / np.ptp(right)
    assert places == pytest.approx(peak / rows, abs=1.0 / BINS)


def moved_to(y_mm: float) -> Measurement:
    """A good one."""
    moved = Displacement(np.array([0.0, y_mm]), np.diag([1e-4, 1e-4]))
    return Measurement(Flag.GOOD, (), corrected=moved, raw=moved, motion=None)


def corrected_line(figure: Path) -> np.ndarray:
    """(2, n) the points of the first line of corrected values in an SVG, to the right and down."""
    line = next(
        path
        for path in ET.parse(figure).getroot().iter("{http://www.w3.org/2000/svg}path")
        if path.get("style", "").startswith("fill: none; stroke: #0072b2")
    )
    points = re.findall(r"[ML] (\S+) (\S+)", line.get("d", ""))
    return np.array(points, dtype=np.float64).T


def test_a_row_alone_between_gaps_is_drawn(ctl: Ctl, tmp_path: Path) -> None:
    """A line has no length there: the row is a dot of the corrected line's colour."""
    (tmp_path / "dcam.toml").write_text(SIMULATED, encoding="utf-8")
    with open_store(tmp_path / "state") as store:
        store.add_calibration(calibration())
        for minute in (0, 3, 6):
            store.add_measurement(full_record(slot(minute), calibration_id=1))
            store.record_gap(slot(minute + 1), slot(minute + 2), GapCause.CRASH, period_s=60)
    paths = ("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state")
    assert ctl("plot", "--output", tmp_path / "a.svg", *paths).code == 0
    dots = [
        use
        for use in ET.parse(tmp_path / "a.svg").getroot().iter("{http://www.w3.org/2000/svg}use")
        if "fill: #0072b2" in use.get("style", "")
    ]
    assert len(dots) == 3 * 5  # three rows; x, y, closure and the blue axis of both motions
