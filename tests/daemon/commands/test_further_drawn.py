"""Further targets of a config: printed, planned and checked before any hangs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pypdfium2
import pytest

from core.discs.disc_finder import find_discs
from core.images import GreyImage
from core.site import CirclesTarget
from tests.daemon.commands.conftest import Ctl
from tests.daemon.commands.test_plan import SITE

EXTRA = """
[[target.extra]]
name = "{name}"
role = "{role}"
kind = "circles"
centres_mm = {centres}
diameter_mm = {diameter}
distance_mm = {distance}
distance_sigma_mm = 20.0
{more}
"""
AS_MAIN = "[[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]]"
LOPSIDED = "[[-20.0, 15.0], [20.0, 15.0], [-4.0, -3.0], [20.0, -15.0]]"


def extra(name: str, **given: str) -> str:
    values = {
        "role": "fixed",
        "centres": AS_MAIN,
        "diameter": "8.0",
        "distance": "11500.0",
        "more": "",
    }
    return EXTRA.format(name=name, **(values | given))


def run(ctl: Ctl, tmp_path: Path, config: str, *words: object) -> tuple[int, str, str]:
    (tmp_path / "dcam.toml").write_text(config)
    ran = ctl("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state", *words)
    return ran.code, ran.out, ran.err


def test_each_layout_is_printed_once_with_the_names_of_its_targets(
    ctl: Ctl, tmp_path: Path
) -> None:
    config = (
        SITE
        + extra("abutment")
        + extra("span-2", role="measured", centres=LOPSIDED, diameter="9.0")
        + extra("span-3", role="measured", centres=LOPSIDED, diameter="9.0", distance="13000.0")
        + extra("far", centres=LOPSIDED, diameter="12.0")
    )
    code, out, err = run(ctl, tmp_path, config, "target", "--output", tmp_path / "p", "--json")
    assert code == 0, err
    files = {Path(one["file"]).name: one["targets"] for one in json.loads(out)["files"]}
    assert files == {
        "target-main.pdf": ["main", "abutment"],
        "target-span-2.pdf": ["span-2", "span-3"],
        "target-far.pdf": ["far"],
        "target-sub.pdf": ["sub"],
    }
    page = pypdfium2.PdfDocument(tmp_path / "p" / "target-span-2.pdf")[0]
    text = page.get_textpage().get_text_range()
    assert "target of the main camera: span-2, span-3" in text
    assert "read from 11500, 13000 mm" in text
    main = pypdfium2.PdfDocument(tmp_path / "p" / "target-main.pdf")[0]
    assert "[target.main], abutment" in main.get_textpage().get_text_range()


def test_a_further_target_is_printed_at_true_scale(ctl: Ctl, tmp_path: Path) -> None:
    config = SITE + extra("span-2", role="measured", centres=LOPSIDED, diameter="9.0")
    assert run(ctl, tmp_path, config, "target", "--output", tmp_path / "p")[0] == 0
    page = pypdfium2.PdfDocument(tmp_path / "p" / "target-span-2.pdf")[0]
    pixels = np.asarray(page.render(scale=200.0 / 72.0, grayscale=True).to_numpy())
    image = GreyImage(np.ascontiguousarray(pixels.reshape(pixels.shape[:2])))
    centres = np.array(json.loads(LOPSIDED))
    target = CirclesTarget(centres, np.full(4, 9.0), 11500.0, 20.0)
    px_per_mm = np.array(pixels.shape[1::-1]) / (np.array(page.get_size()) * 25.4 / 72.0)
    discs = find_discs(image, target, 200.0 / 25.4)
    apart_mm = (discs.points_px - discs.points_px[0]) / px_per_mm
    assert apart_mm == pytest.approx((centres - centres[0]) * [1.0, -1.0], abs=0.03)


def test_plan_says_what_is_seen_of_each(ctl: Ctl, tmp_path: Path) -> None:
    config = (
        SITE
        + extra("abutment", more="position_px = [489.5, 199.5]")
        + extra("span-2", role="measured", centres=LOPSIDED, diameter="9.0", distance="20000.0")
    )
    code, out, err = run(ctl, tmp_path, config, "plan", "--json")
    assert code == 0, err
    planned = json.loads(out)
    near, far = planned["further_targets"]
    scale = 800e3 / 17.58 / 11500.0
    assert (near["name"], near["role"], far["role"]) == ("abutment", "fixed", "measured")
    assert near["px_per_mm"] == pytest.approx(scale)
    assert near["field_mm"] == pytest.approx([640 / scale, 400 / scale])
    assert near["disc_px"] == pytest.approx(8.0 * scale)
    room = 150 / scale - 15.0 - 4.0
    assert near["travel_mm"][0] == pytest.approx(room, abs=2.0)  # the outline's blur is in it
    assert far["px_per_mm"] == pytest.approx(scale * 11500 / 20000)
    assert far["travel_mm"] is None
    assert planned["warnings"] == []
    code, out, err = run(ctl, tmp_path, config, "plan")
    (line,) = [line for line in out.splitlines() if line.startswith("abutment, fixed")]
    assert "3.96 px/mm" in line
    assert "162 x 101 mm" in line
    assert "no position_px" in next(line for line in out.splitlines() if "span-2" in line)


@pytest.mark.parametrize(
    ("given", "warning"),
    [
        ({}, "looks like the main target in the image: write its position_px"),
        ({"more": "position_px = [600.0, 200.0]"}, "hang it nearer to the middle of the image"),
        (
            {"centres": LOPSIDED, "diameter": "4.0", "distance": "30000.0"},
            "a disc is only 6.1 px across, 12 px are needed",
        ),
    ],
)
def test_plan_and_check_warn_of_what_will_not_be_seen(
    ctl: Ctl, tmp_path: Path, given: dict[str, str], warning: str
) -> None:
    config = SITE + extra("abutment", **given)
    for command in ("plan", "check"):
        _, out, _ = run(ctl, tmp_path, config, command)
        warned = [line for line in out.splitlines() if "abutment" in line and "warning" in line]
        assert any(warning in line for line in warned), command


def test_check_gives_the_scale_of_each(ctl: Ctl, tmp_path: Path) -> None:
    config = SITE + extra("abutment", more="position_px = [450, 200]")
    _, out, _ = run(ctl, tmp_path, config, "check", "--json")
    items = {one["name"]: one for one in json.loads(out)["findings"]}
    assert items["target abutment"]["state"] == "ok"
    assert items["target abutment"]["text"].startswith("3.96 px/mm at 11500 mm, fixed, it may move")


@pytest.mark.parametrize("name", ["main", "raw", "sigma", "closure", "spread", "reading"])
def test_a_name_that_would_hide_other_columns_is_refused(
    ctl: Ctl, tmp_path: Path, name: str
) -> None:
    code, _, err = run(ctl, tmp_path, SITE + extra(name), "check")
    assert code == 3
    assert f'target.extra[0].name: "{name}" is taken' in err


def test_a_site_without_further_targets_is_drawn_as_before(ctl: Ctl, tmp_path: Path) -> None:
    _, out, _ = run(ctl, tmp_path, SITE, "target", "--output", tmp_path / "p", "--json")
    assert [Path(one["file"]).name for one in json.loads(out)["files"]] == [
        "target-main.pdf",
        "target-sub.pdf",
    ]
    page = pypdfium2.PdfDocument(tmp_path / "p" / "target-main.pdf")[0]
    first = page.get_textpage().get_text_range().partition("target of the main camera")[2]
    assert first.splitlines()[0] == ""
    assert "further" not in run(ctl, tmp_path, SITE, "plan")[1]
    assert "target " not in run(ctl, tmp_path, SITE, "check")[1].replace("the target may", "")
