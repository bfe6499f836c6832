"""Five calibrations in a simulated year: one record, right to its stated sigma from end to end."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daemon.config.reading import load_config
from daemon.ctl import cli
from daemon.error_report import run
from tests.daemon.commands.conftest import Ctl
from tests.daemon.datum.year import (
    BONDED_AGAIN,
    CALIBRATIONS,
    FIXED_PLATE,
    NOTHING_CHANGES,
    Values,
    Year,
    values_of,
    write_year,
)
from tests.laboratory import laboratory


@pytest.fixture(scope="module")
def year(tmp_path_factory: pytest.TempPathFactory) -> Year:
    """The sets, each calibrated in turn and its rows measured, as somebody at the pier would."""
    directory = tmp_path_factory.mktemp("year")
    config = directory / "dcam.toml"
    config.write_text(laboratory(640, square_mm=6.0) + FIXED_PLATE + NOTHING_CHANGES)
    made = write_year(directory, load_config(config).site())
    site = ["--config", str(config), "--state", str(directory / "state")]
    for number, images in enumerate(made.sets, start=1):
        table = directory / f"{number}.csv"
        assert run(cli, "dcam-ctl", [*site, "calibrate", "--from", str(images), "--accept"]) == 0
        measuring = ["reprocess", "--from", str(images), "--output", str(table)]
        assert run(cli, "dcam-ctl", [*site, *measuring]) == 0
    return made


@pytest.fixture
def ask(year: Year, ctl: Ctl) -> Callable[..., Any]:
    """`dcam-ctl` on the year's state."""
    site = ("--config", year.directory / "dcam.toml", "--state", year.directory / "state")
    return lambda *words: ctl(*site, *words)


def values(year: Year, number: int) -> Values:
    return values_of(year.directory / f"{number}.csv")


def test_the_record_is_right_to_its_sigma_from_end_to_end(year: Year) -> None:
    ratios = []
    for number in range(1, CALIBRATIONS + 1):
        found = values(year, number)
        error_mm = found.mm - year.truth_mm(found.slots_utc)
        ratios.append(error_mm / found.sigma_mm)
    # Errors of one calibration's rows are alike; each is honest, and all of them together.
    assert np.abs(ratios).max() < 3.5
    assert 0.1 < np.sqrt(np.mean(np.square(ratios))) < 1.7


def test_the_bridge_moved_by_more_than_any_sigma(year: Year) -> None:
    """Without datums the rows of the later calibrations would be wrong by millimetres."""
    moved_mm = year.truth_mm([year.reference_utc(n) for n in range(2, CALIBRATIONS + 1)])
    sigma_mm = values(year, CALIBRATIONS).sigma_mm.max()
    assert sigma_mm < 0.2
    assert np.abs(moved_mm[:, 1]).min() > 5.0 * sigma_mm


def test_the_sigma_grows_from_link_to_link(ask: Callable[..., Any]) -> None:
    links = json.loads(ask("datum", "--json").out)["calibrations"]
    sigmas_mm = [link["sigma_y_mm"] for link in links]
    assert sigmas_mm[0] == 0.0
    assert sigmas_mm == sorted(sigmas_mm)
    for link in links[1:]:
        by = (
            {"fixed_targets"}
            if link["calibration"] in BONDED_AGAIN
            else {
                "fixed_targets",
                "old_calibration",
            }
        )
        assert link["method"] in by


def test_rows_on_both_sides_of_a_calibration_agree(
    year: Year, ask: Callable[..., Any], tmp_path: Path
) -> None:
    """The last rows before the third calibration, by the second one and by the third."""
    table = tmp_path / "again.csv"
    words = ("--from", year.sets[1], "--calibration", 3, "--output", table)
    assert ask("reprocess", *words).code == 0
    before, after = values(year, 2), values_of(table)
    sigma_mm = np.hypot(before.sigma_mm, after.sigma_mm)
    assert (np.abs(before.mm - after.mm) < 3.5 * sigma_mm).all()


def test_a_bonded_board_is_not_believed_and_the_report_says_why(
    year: Year, ask: Callable[..., Any]
) -> None:
    ran = ask("calibrate", "--from", year.sets[-1], "--json")
    assert ran.code == 0, ran.err
    lines = json.loads(ran.out)["lines"]
    assert any(line.startswith("zero: x ") for line in lines)
