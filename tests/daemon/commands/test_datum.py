"""`dcam-ctl datum` and `calibrate` from outside: one zero, how it was found, and what to do."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.results import Displacement, Flag, Measurement
from daemon.store.database import open_store
from daemon.store.records import DatumMethod, DatumStep, Reading
from daemon.store.rows.circumstances import KEY, Circumstances, circumstances_of
from tests.daemon.commands.conftest import Ctl, Ran, Site, edit_table
from tests.daemon.rows import add_rows
from tests.daemon.store.examples import calibration, datum, record

LATER = timedelta(days=1)


class Chain:
    """A state with a calibration, to which another is added from the same images a day later."""

    def __init__(self, bench: Path, later: Path, state: Path, directory: Path, ctl: Ctl) -> None:
        self._ctl, self.config = ctl, bench / "dcam.toml"
        self.state = Path(shutil.copytree(state, directory / "state"))
        self.first, self.later = bench / "set", later
        self.said = ""
        """By the calibration a day later."""

    def ctl(self, *arguments: object) -> Ran:
        return self._ctl("--config", self.config, "--state", self.state, *arguments)

    def calibrate(self, *options: object) -> Ran:
        ran = self.ctl("calibrate", "--from", self.later, "--accept", *options)
        assert ran.code == 0, ran.err
        return ran

    def links(self) -> list[dict[str, Any]]:
        ran = self.ctl("datum", "--json")
        assert ran.code == 0, ran.err
        found: list[dict[str, Any]] = json.loads(ran.out)["calibrations"]
        return found


def _later(line: str) -> str:
    slot, _, rest = line.partition(",")
    return f"{(datetime.fromisoformat(slot) + LATER):%Y-%m-%dT%H:%M:%SZ},{rest}"


@pytest.fixture(scope="module")
def later(bench: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The frame set with the times of a day later, and half of its rig views; not to be changed."""
    made = Path(shutil.copytree(bench / "set", tmp_path_factory.mktemp("later") / "set"))
    edit_table(made, lambda lines: [lines[0], *map(_later, _with_half_of_the_rig(lines[1:]))])
    return made


def _with_half_of_the_rig(lines: list[str]) -> list[str]:
    left_out = [line for line in lines if ",rig," in line][::2]
    return [line for line in lines if line not in left_out]


@pytest.fixture
def chain(bench: Path, later: Path, calibrated: Path, tmp_path: Path, ctl: Ctl) -> Chain:
    return Chain(bench, later, calibrated, tmp_path, ctl)


Continued = Callable[..., Chain]


@pytest.fixture(scope="module")
def made_later() -> dict[tuple[object, ...], tuple[Path, str]]:
    """States with the second calibration, by its options, and what it said; not to be changed."""
    return {}


@pytest.fixture
def continued(
    chain: Chain,
    made_later: dict[tuple[object, ...], tuple[Path, str]],
    tmp_path_factory: pytest.TempPathFactory,
) -> Continued:
    """Give the chain with the second calibration; with the same options it is made once."""

    def give(*options: object) -> Chain:
        if options in made_later:
            state, chain.said = made_later[options]
            shutil.rmtree(chain.state)
            shutil.copytree(state, chain.state)
        else:
            chain.said = chain.calibrate(*options).out
            kept = tmp_path_factory.mktemp("continued") / "state"
            made_later[options] = Path(shutil.copytree(chain.state, kept)), chain.said
        return chain

    return give


def test_lens_views_since_the_old_reference_mean_that_the_board_was_taken_off(
    continued: Continued,
) -> None:
    chain = continued()
    said = chain.said
    assert "zero: not measured by calibration 1: lens views of 2026-03-01T23:46:00Z" in said
    assert "by the last good row" in said
    first, second = chain.links()
    assert (first["method"], first["x_mm"], first["sigma_x_mm"]) == ("origin", 0.0, 0.0)
    assert second["method"] == "rows"
    # The rows before are hours away from the reference, and the bridge moves by millimetres.
    assert second["sigma_y_mm"] > 1.0
    assert abs(second["y_mm"]) < 3.0 * second["sigma_y_mm"]


def test_an_untouched_board_carries_the_zero_over(continued: Continued) -> None:
    chain = continued("--board-untouched")
    said = chain.said
    assert "zero: x " in said
    assert "measured by calibration 1" in said
    _, second = chain.links()
    assert second["method"] == "old_calibration"
    # The images are those of the first reference: nothing has moved.
    # A day later the budget of the sub lens is most of it: 0.05 px of this coarse camera.
    assert 0.0 < second["sigma_y_mm"] < 0.4
    assert abs(second["x_mm"]) < 3.0 * second["sigma_x_mm"]
    assert abs(second["y_mm"]) < 3.0 * second["sigma_y_mm"]
    item = next(i for i in json.loads(status(chain).out)["items"] if i["name"] == "zero")
    assert item["level"] == "ok"
    assert "old_calibration" in item["text"]


def test_another_camera_and_the_readings_at_the_zero_are_in_the_report(chain: Chain) -> None:
    """Calibration 2 was made with main camera 100; the board was not touched since."""
    with open_store(chain.state) as store:
        (first,) = store.calibrations()
        content = {**first.content, KEY: Circumstances({"main": "100"}).to_dict()}
        store.add_calibration(
            replace(first, id=None, content=content), store.datum(1), activate=True
        )
    config = chain.config.read_text()
    chain.config = chain.state.parent / "dcam.toml"
    serial = config.replace("[camera.main]", '[camera.main]\nserial = "200"', 1)
    chain.config.write_text(
        f'{serial}\n[[reading]]\nname = "air"\nunit = "degC"\nfile = "/sys/none"\n'
    )
    chain.later = Path(shutil.copytree(chain.later, chain.state.parent / "later"))
    edit_table(chain.later, lambda lines: [f"{lines[0]},reading_air", *_with(lines[1:], "12.5")])
    said = chain.calibrate("--board-untouched").out
    assert "readings at the reference: air 12.5 degC" in said
    (line,) = [line for line in said.splitlines() if "not measured by calibration 2" in line]
    assert "the main camera is another one, serial 200 after 100" in line
    assert "(nothing else is believed)" in said
    with open_store(chain.state) as store:
        kept = circumstances_of(store.calibrations()[-1].content)
    assert kept.serials["main"] == "200"
    assert kept.readings == (Reading("air", "degC", 12.5),)


def _with(lines: list[str], value: str) -> list[str]:
    return [f"{line},{value}" for line in lines]


def test_the_same_images_calibrated_again_have_the_same_zero(continued: Continued) -> None:
    """Also behind another one: the offset of the first calibration on them is known exactly."""
    chain = continued("--board-untouched")
    ran = chain.ctl("calibrate", "--from", chain.later, "--accept", "--method", "paper")
    assert ran.code == 0, ran.err
    assert "which is that of calibration 2" in ran.out
    _, second, third = chain.links()
    assert third["method"] == "same_reference"
    assert (third["x_mm"], third["sigma_y_mm"]) == (second["x_mm"], second["sigma_y_mm"])
    ran = chain.ctl("calibrate", "--from", chain.first, "--accept")
    assert ran.code == 0, ran.err
    assert (chain.links()[-1]["y_mm"], chain.links()[-1]["sigma_y_mm"]) == (0.0, 0.0)


def test_a_survey_moves_rows_and_is_shown_with_its_source(
    continued: Continued, tmp_path: Path
) -> None:
    chain = continued("--board-untouched")
    moved_mm = 12.3 - chain.links()[1]["y_mm"]
    table = tmp_path / "a.csv"
    assert chain.ctl("reprocess", "--from", chain.later, "--output", table).code == 0
    before = table.read_text()
    ran = chain.ctl("datum", "set", "--y", "12.3", "--sigma", "0.5", "--source", "levelling")
    assert ran.code == 0, ran.err
    assert "changed: calibration 2" in ran.out
    assert "+12.300 ± 0.5" in ran.out
    assert "levelling" in ran.out
    assert chain.ctl("reprocess", "--from", chain.later, "--output", table).code == 0
    for old, new in zip(before.splitlines()[1:], table.read_text().splitlines()[1:], strict=True):
        x_mm, y_mm, _, sigma_y_mm = map(float, new.split(",")[3:7])
        assert y_mm == pytest.approx(float(old.split(",")[4]) + moved_mm, abs=1e-3)
        assert x_mm == pytest.approx(float(old.split(",")[3]), abs=1e-3)
        assert sigma_y_mm == pytest.approx(0.5, abs=0.05)


def test_frames_that_both_calibrations_measured_join_them(continued: Continued) -> None:
    chain = continued()
    wide = chain.links()[1]["sigma_y_mm"]
    ran = chain.ctl("datum", "adjust", "--from", chain.later)
    assert ran.code == 0, ran.err
    assert "4 pairs measured by both" in ran.err
    _, second = chain.links()
    assert second["method"] == "adjusted"
    assert second["sigma_y_mm"] < 0.4 < wide
    # Both have the images of the same reference.
    assert abs(second["y_mm"]) < 3.0 * second["sigma_y_mm"]


def test_frames_that_contradict_the_link_are_not_believed_without_a_word(
    continued: Continued,
) -> None:
    chain = continued()
    assert chain.ctl("datum", "set", "--x", 40, "--y", 0, "--sigma", 0.1, "--source", "x").code == 0
    ran = chain.ctl("datum", "adjust", "--from", chain.later)
    assert ran.code == 1
    assert "the board, a lens or a camera was touched" in ran.err
    assert "--board-untouched" in ran.err
    assert chain.links()[1]["x_mm"] == pytest.approx(40.0)
    told = chain.ctl("datum", "adjust", "--from", chain.later, "--board-untouched")
    assert told.code == 0, told.err
    assert chain.links()[1]["method"] == "adjusted"


def test_frames_of_another_camera_join_nothing_but_rows_on_both_sides_do(chain: Chain) -> None:
    """Calibrations 2 and 3 are one calibration in the store, with another camera each."""
    moved_mm, noise_mm2 = np.array([0.5, 3.0]), 1e-4 * np.eye(2)
    with open_store(chain.state) as store:
        (first,) = store.calibrations()
        references = [utc("2026-03-05T12:00:00"), utc("2026-03-09T12:00:00")]
        for number, reference_utc in enumerate(references, start=2):
            made_with = Circumstances({"main": f"{number}00"}).to_dict()
            made = replace(first, id=None, content={**first.content, KEY: made_with})
            link = replace(datum(0.0, 2.0, 9.0), reference_utc=reference_utc)
            steps = (DatumStep(DatumMethod.ROWS, 2, link.offset),) if number == 3 else link.steps
            store.add_calibration(made, replace(link, steps=steps), activate=True)
            mm = np.zeros(2) if number == 2 else -moved_mm
            seen = Measurement(Flag.GOOD, (), Displacement(mm, noise_mm2), None, None)
            slots_utc = [reference_utc + timedelta(minutes=10 * k) for k in range(1, 201)]
            rows = [
                replace(record(slot_utc, seen), calibration_id=number) for slot_utc in slots_utc
            ]
            add_rows(store, rows)
    ran = chain.ctl("datum", "adjust", "--from", chain.later)
    assert ran.code == 0, ran.err
    assert "the main camera is another one, serial 300 after 200" in ran.err
    assert "rows before and after" in ran.err
    *_, second, third = chain.links()
    assert third["method"] == "adjusted"
    assert third["y_mm"] - second["y_mm"] == pytest.approx(3.0, abs=0.05)
    # The second one's own sigma, 9 mm, and next to nothing more.
    assert third["sigma_y_mm"] == pytest.approx(second["sigma_y_mm"], abs=0.1)
    again = chain.ctl("datum", "adjust", "--from", chain.later)
    assert again.code == 1
    assert "the present link is known better" in again.err


def utc(text: str) -> datetime:
    return datetime.fromisoformat(f"{text}+00:00")


def status(chain: Chain) -> Ran:
    return chain.ctl("status", "--json")


# Without images: what the commands make of what is stored.


def unlinked(site: Site) -> None:
    """A second calibration of a version that knew no datum."""
    site.write(lambda store: store.add_calibration(calibration(), activate=True) and None)


def test_a_calibration_without_a_link_is_told(site: Site) -> None:
    unlinked(site)
    site.measure(1)
    said = site.ctl("datum").out
    assert "not linked" in said
    ran = site.status()
    assert site.levels(ran)["zero"] == "warning"
    assert "dcam-ctl datum set or adjust" in ran.out
    options = ("--x", 1, "--y", 2, "--sigma", 0.1, "--source", "gauge")
    assert site.ctl("datum", "set", *options).code == 0
    assert site.levels(site.status())["zero"] == "ok"


def test_a_single_calibration_has_no_word_of_it_in_status(site: Site) -> None:
    assert "zero" not in site.levels(site.status())


def test_a_lost_zero_is_a_warning_that_says_what_to_do(site: Site) -> None:
    lost = replace(datum(0.0, 0.0, 60.0), method=DatumMethod.LOST)
    site.write(lambda store: store.add_calibration(calibration(), lost, activate=True) and None)
    ran = site.status()
    assert site.levels(ran)["zero"] == "warning"
    assert "enter a surveyed value with dcam-ctl datum set" in ran.out


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("set --sigma 0.5 --source x", 2, "give --x, --y or both"),
        ("set --y 1 --sigma 0 --source x", 2, "--sigma"),
        ("set --y 1 --sigma 1", 2, "--source"),
        ("set --y nan --sigma 1 --source x", 2, "--y"),
        ("set --y 1 --sigma 1 --source x --calibration 9", 1, "no calibration 9"),
        ("adjust", 1, "no calibration before 1"),
        ("adjust --calibration 1 --with 3", 2, "--with 3 is not earlier than calibration 1"),
        ("adjust --from . --since 1d", 2, "leave them out with --from"),
        ("--json set --y 1 --sigma 1 --source x", 2, "give --json behind set"),
        ("sett", 2, "Did you mean 'set'?"),
    ],
)
def test_a_mistake_is_one_clear_line(site: Site, words: str, code: int, said: str) -> None:
    ran = site.ctl("datum", *words.split())
    assert (ran.code, said in ran.err) == (code, True), ran.err
    with open_store(site.state) as store:
        assert store.datum_links() == []


def test_without_a_database_nothing_is_made(tmp_path: Path, ctl: Ctl) -> None:
    ran = ctl("--state", tmp_path / "none", "datum")
    assert ran.code == 5
    assert not (tmp_path / "none").exists()
