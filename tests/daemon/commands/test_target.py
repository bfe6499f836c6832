"""The printed targets, looked at as prints: rasterised, then measured by our own detectors."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pypdfium2
import pytest

from core.checkerboard.board import Board
from core.checkerboard.corners import detect_board
from core.discs.disc_finder import find_discs
from core.images import GreyImage
from core.site import CheckerboardTarget, CirclesTarget
from daemon.config.reading import load_config
from tests.daemon.commands.conftest import LABORATORY, Ctl

DPI = 200.0
PX_PER_MM = DPI / 25.4
FIELD = (
    LABORATORY.replace(
        "[[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]]",
        "[[-30.0, 22.0], [30.0, 22.0], [0.0, 0.0], [-30.0, -22.0], [30.0, -22.0]]",
    )
    .replace("diameter_mm = 8.0", "diameter_mm = 16.0")
    .replace("distance_mm = 11000.0", "distance_mm = 22000.0")
)
LOPSIDED = LABORATORY.replace("[0.0, 0.0]", "[4.0, 3.0]")
"""No mirror image of itself."""


class Print:
    """One printed page."""

    def __init__(self, directory: Path, reported: dict) -> None:
        self.described = reported
        page = pypdfium2.PdfDocument(directory / Path(reported["file"]).name)[0]
        self.size_mm = np.array(page.get_size()) * 25.4 / 72.0
        self.text = page.get_textpage().get_text_range()
        self.pixels = np.asarray(page.render(scale=DPI / 72.0, grayscale=True).to_numpy())
        self.pixels = np.ascontiguousarray(self.pixels.reshape(self.pixels.shape[:2]))

        # The renderer stretches a page to whole pixels.
        self.px_per_mm = np.array(self.pixels.shape[::-1]) / self.size_mm

    def page_mm(self, points_px: np.ndarray) -> np.ndarray:
        """From pixel centres to mm from the top left corner of the page."""
        return (points_px + 0.5) / self.px_per_mm

    def seen(self) -> GreyImage:
        """The page as a camera sees it: no lens is as sharp as a drawing."""
        return GreyImage(cv2.GaussianBlur(self.pixels, (0, 0), 0.7))

    def marks_mm(self, ruler: dict) -> np.ndarray:
        """Where a ruler's ticks are, along it, by the middle of their ink."""
        pixels = self.pixels.T if ruler["vertical"] else self.pixels
        along, across = ruler["x_mm"], ruler["y_mm"] + 1.0
        if ruler["vertical"]:
            along, across = ruler["y_mm"], ruler["x_mm"] - 1.0
        line = 255.0 - pixels[round(across * PX_PER_MM)].astype(float)
        first = max(0, round((along - 0.5) * PX_PER_MM))
        line = line[first : round((along + ruler["length_mm"] + 0.5) * PX_PER_MM)]
        dark = np.flatnonzero(np.diff(np.concatenate([[0], line > 60.0, [0]])))
        reach = [range(a - 1, b + 1) for a, b in dark.reshape(-1, 2)]
        middle = [np.average(r, weights=line[list(r)]) for r in reach]
        return (np.array(middle) + first + 0.5) / self.px_per_mm[int(ruler["vertical"])]


def printed(ctl: Ctl, tmp_path: Path, config: str) -> dict[str, Print]:
    (tmp_path / "dcam.toml").write_text(config)
    ran = ctl(
        *("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state"),
        *("target", "--output", tmp_path / "prints", "--json"),
    )
    assert ran.code == 0, ran.err
    files = json.loads(ran.out)["files"]
    return {Path(reported["file"]).stem: Print(tmp_path / "prints", reported) for reported in files}


def site_of(tmp_path: Path):
    return load_config(tmp_path / "dcam.toml").site()


def similarity(from_mm: np.ndarray, to_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Affine map by least squares: its matrix, its shift, and the largest miss."""
    design = np.column_stack([from_mm, np.ones(len(from_mm))])
    solution = np.linalg.lstsq(design, to_mm, rcond=None)[0]
    miss = np.abs(design @ solution - to_mm).max()
    return solution[:2].T, solution[2], float(miss)


@pytest.mark.parametrize(
    "config", [LABORATORY, LABORATORY.replace("squares_x = 32", "squares_x = 21")]
)
def test_the_printed_board_is_the_one_the_software_finds(
    ctl: Ctl, tmp_path: Path, config: str
) -> None:
    """Its corners lie where the board as drawn has them, x right and y down from the origin."""
    page = printed(ctl, tmp_path, config)["target-sub"]
    board = Board.nominal(site_of(tmp_path).sub_target)
    located = detect_board(page.seen(), board)
    assert len(located.view.index) == len(board.corners_mm)
    assert located.unambiguous
    on_page = page.page_mm(located.view.points_px)
    matrix, shift, miss_mm = similarity(board.corners_mm[located.view.index, :2], on_page)
    assert matrix == pytest.approx(np.eye(2), abs=5e-4)  # true pitch, upright, not mirrored
    assert miss_mm < 0.02
    assert shift == pytest.approx(page.described["origin_mm"], abs=0.01)


def test_the_square_at_the_origin_is_black_and_the_board_stands_on_white(
    ctl: Ctl, tmp_path: Path
) -> None:
    page = printed(ctl, tmp_path, LABORATORY)["target-sub"]
    target: CheckerboardTarget = site_of(tmp_path).sub_target
    x, y = page.described["origin_mm"]
    size = np.array([target.squares_x, target.squares_y]) * target.square_mm

    def grey(x_mm: float, y_mm: float) -> int:
        return int(page.pixels[int(y_mm * PX_PER_MM), int(x_mm * PX_PER_MM)])

    assert grey(x + 0.5, y + 0.5) == 0
    assert grey(x + 2.5, y + 0.5) == 255
    for away in np.arange(0.2, 9.8, 0.4):
        for t in np.arange(-9.0, size[0] + 9.0, 0.7):
            assert grey(x + t, y - away) == 255
            assert grey(x + t, y + size[1] + away) == 255
        for t in np.arange(-9.0, size[1] + 9.0, 0.7):
            assert grey(x - away, y + t) == 255
            assert grey(x + size[0] + away, y + t) == 255


@pytest.mark.parametrize("config", [LOPSIDED, FIELD], ids=["lopsided", "22 m"])
def test_the_printed_discs_are_the_ones_the_software_finds(
    ctl: Ctl, tmp_path: Path, config: str
) -> None:
    """Centres and diameters to a part in a thousand; y up."""
    page = printed(ctl, tmp_path, config)["target-main"]
    target: CirclesTarget = site_of(tmp_path).main_target
    discs = find_discs(page.seen(), target, PX_PER_MM)
    assert discs.found.all()
    on_page = page.page_mm(discs.points_px)
    matrix, shift, miss_mm = similarity(target.centres_mm * [1.0, -1.0], on_page)
    assert matrix == pytest.approx(np.eye(2), abs=1e-3)
    assert miss_mm < 0.01
    assert shift == pytest.approx(page.described["origin_mm"], abs=0.01)
    for middle, diameter_mm in zip(on_page, target.diameters_mm, strict=True):
        low, high = ((middle + s * 0.75 * diameter_mm) * PX_PER_MM for s in (-1, 1))
        window = page.pixels[round(low[1]) : round(high[1]), round(low[0]) : round(high[0])]
        area_mm2 = window.astype(float).sum() / 255.0 / page.px_per_mm.prod()
        assert 2.0 * np.sqrt(area_mm2 / np.pi) == pytest.approx(diameter_mm, rel=1e-3)


@pytest.mark.parametrize("name", ["target-main", "target-sub"])
def test_rulers_are_true_in_both_directions(ctl: Ctl, tmp_path: Path, name: str) -> None:
    page = printed(ctl, tmp_path, LABORATORY)[name]
    assert {ruler["vertical"] for ruler in page.described["rulers"]} == {True, False}
    for ruler in page.described["rulers"]:
        marks = page.marks_mm(ruler)
        assert ruler["length_mm"] >= 100.0
        assert len(marks) == ruler["length_mm"] + 1
        assert np.diff(marks) == pytest.approx(1.0, abs=0.02)
        assert marks[-1] - marks[0] == pytest.approx(ruler["length_mm"], rel=1e-3)


def test_a_sheet_names_its_site_its_drawing_and_how_to_mount_it(ctl: Ctl, tmp_path: Path) -> None:
    pages = printed(ctl, tmp_path, LABORATORY.replace('"bench"', '"Brücke 橋"'))
    for page in pages.values():
        for words in ("Brücke", "100 %", "glass", "foam", "matt"):
            assert words in page.text
    assert "32 x 31 squares of 2 mm" in pages["target-sub"].text
    assert "top left in the sub image" in pages["target-sub"].text
    assert "mirrored" in pages["target-sub"].text
    assert "8 mm" in pages["target-main"].text
    assert "(-15, 11)" in pages["target-main"].text
    assert "UP" in pages["target-main"].text


def test_the_page_fits_the_target(ctl: Ctl, tmp_path: Path) -> None:
    a4 = printed(ctl, tmp_path, LABORATORY)["target-sub"]
    assert a4.described["page"] == "A4"
    assert a4.size_mm == pytest.approx([210.0, 297.0], abs=0.01)
    a3 = printed(ctl, tmp_path, LABORATORY.replace("square_mm = 2.0", "square_mm = 7.0"))[
        "target-sub"
    ]
    assert a3.described["page"] == "A3"
    own = printed(ctl, tmp_path, LABORATORY.replace("square_mm = 2.0", "square_mm = 14.0"))
    assert own["target-sub"].size_mm[0] > 32 * 14.0 + 20.0
    assert own["target-sub"].size_mm == pytest.approx(
        own["target-sub"].described["page_mm"], abs=0.01
    )


def test_a_directory_that_cannot_be_made_is_said_in_one_line(ctl: Ctl, tmp_path: Path) -> None:
    (tmp_path / "dcam.toml").write_text(LABORATORY)
    (tmp_path / "file").write_text("")
    ran = ctl(
        *("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state"),
        *("target", "--output", tmp_path / "file" / "prints"),
    )
    assert ran.code == 4
    assert len(ran.err.splitlines()) == 1
