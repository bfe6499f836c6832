"""`dcam-ctl plan`: from the config alone; what it predicts is what then comes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.daemon.commands.conftest import CONFIG, Ctl, Ran

SITE = CONFIG.replace("squares_y = 15", "squares_y = 14")
"""Few corners, so that many plans take little time; nothing about it is to be warned of."""


def plan(ctl: Ctl, tmp_path: Path, config: str = SITE, *options: object) -> Ran:
    (tmp_path / "dcam.toml").write_text(config)
    return ctl("--config", tmp_path / "dcam.toml", "--state", tmp_path / "state", "plan", *options)


def planned(ctl: Ctl, tmp_path: Path, config: str = SITE, *options: object) -> dict:
    """What a program is told; the same plan is made once."""
    if (config, options) not in PLANNED:
        ran = plan(ctl, tmp_path, config, "--json", *options)
        assert ran.code == 0, ran.err
        PLANNED[config, options] = ran.out
    return json.loads(PLANNED[config, options])


PLANNED: dict[tuple[str, tuple[object, ...]], str] = {}


def changed(config: str, *changes: tuple[str, str]) -> str:
    """The config with something else in it."""
    for old, new in changes:
        assert old in config
        config = config.replace(old, new)
    return config


def test_json_tells_scales_room_and_sigma(ctl: Ctl, tmp_path: Path) -> None:
    """The geometry by hand; what a program may rely on is there."""
    reported = planned(ctl, tmp_path)
    assert (reported["schema"], reported["command"]) == (1, "plan")
    scale = 800e3 / 17.58 / 11000.0
    assert reported["main_px_per_mm"] == pytest.approx(scale)
    assert reported["sub_px_per_mm"] == pytest.approx(6e3 / 17.58 / 50.0)
    assert reported["square_px"] == pytest.approx(4.0 * reported["sub_px_per_mm"])
    assert reported["main_field_mm"] == pytest.approx([640 / scale, 400 / scale])
    assert reported["disc_px"] == pytest.approx(8.0 * scale)
    assert reported["drift_mm"] == pytest.approx(11.0 + 1.5)  # 1 mrad at 11 m, and 1.5 mm
    assert reported["affine_error_px"] == pytest.approx(1.5 / 11000.0 * 15.0 * scale, rel=0.01)
    assert reported["corners"] == 15 * 13
    assert reported["warnings"] == []
    assert reported["failure"] is None
    predicted = reported["predicted"]
    assert predicted["typical_mm"] == max(predicted["drifted_mm"])
    assert predicted["worst_mm"] == max(motion["row_mm"] for motion in predicted["motions"])
    assert len(predicted["motions"]) == 6
    for motion in predicted["motions"]:
        assert 0.0 < motion["calibration_mm"] < motion["row_mm"]
    assert max(predicted["still_mm"]) < predicted["typical_mm"]
    for limit in reported["limits"]:
        assert 0.0 < limit["without_mm"] <= predicted["typical_mm"] * (1.0 + 1e-9)
    assert all(x["typical_mm"] < 0.9 * predicted["typical_mm"] for x in reported["improvements"])


def test_what_is_said_to_better_it_does(ctl: Ctl, tmp_path: Path) -> None:
    """A site changed as the plan says has the sigma that it said."""
    now = planned(ctl, tmp_path)
    (larger,) = [x for x in now["improvements"] if "larger board" in x["what"]]
    assert "23 x 20 squares" in larger["what"]
    larger_site = changed(
        SITE, ("squares_x = 16", "squares_x = 23"), ("squares_y = 14", "squares_y = 20")
    )
    then = planned(ctl, tmp_path, larger_site)
    assert then["predicted"]["typical_mm"] == pytest.approx(larger["typical_mm"])
    assert then["predicted"]["typical_mm"] < 0.9 * now["predicted"]["typical_mm"]


def test_noisier_images_and_a_shorter_reach_are_worse(ctl: Ctl, tmp_path: Path) -> None:
    usual = planned(ctl, tmp_path)["predicted"]
    noisy = planned(ctl, tmp_path, SITE, "--noise-dn", "3")["predicted"]
    assert 2.0 < max(noisy["still_mm"]) / max(usual["still_mm"]) < 3.1
    short = planned(ctl, tmp_path, SITE, "--reach-deg", "0.03", "0.03")
    assert np.abs(short["positions_deg"]).max() == pytest.approx(0.03)
    assert short["predicted"]["worst_mm"] > 1.02 * usual["worst_mm"]


def test_the_kind_of_lens_counts(ctl: Ctl, tmp_path: Path) -> None:
    """A fisheye shows the edge of the board in fewer pixels than another of its focal length."""
    usual = planned(ctl, tmp_path)["predicted"]
    lens = ("focal_length_mm = 6.0", 'focal_length_mm = 6.0\nlens_model = "fisheye"')
    fisheye = planned(ctl, tmp_path, changed(SITE, lens))["predicted"]
    assert 1.02 < fisheye["typical_mm"] / usual["typical_mm"] < 2.0


def test_text_says_sigma_causes_and_changes(ctl: Ctl, tmp_path: Path) -> None:
    reported = planned(ctl, tmp_path)
    ran = plan(ctl, tmp_path)
    assert ran.code == 0
    assert ran.err == ""
    assert f"predicted: 1 sigma of {reported['predicted']['typical_mm']:.2g} mm" in ran.out
    assert "12 lens views, 23 positions of the head" in ran.out
    assert f"{reported['limits'][0]['without_mm']:.4f}" in ran.out
    for better in reported["improvements"]:
        assert f"{better['typical_mm']:.4f}  " in ran.out
        assert better["what"] in ran.out
    assert "warning" not in ran.out


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("square_mm = 4.0", "square_mm = 1.5"), "a square is only 10.2 px"),
        (("diameter_mm = 8.0", "diameter_mm = 2.0"), "a disc is only 8.3 px across"),
        (("offset_sigma_mm", "[quality]\nmax_sigma_mm = 0.01\n[rig]\noffset_sigma_mm"), "flagged"),
        (("distance_mm = 50.0", "distance_mm = 25.0"), "no border of the board in view at left"),
    ],
    ids=["squares", "discs", "sigma", "border"],
)
def test_what_is_too_small_or_too_large_is_warned_of(
    ctl: Ctl, tmp_path: Path, change: tuple[str, str], words: str
) -> None:
    if "[rig]" in change[1]:  # sections may not be split: the limit comes last
        config = SITE + change[1].partition("[rig]")[0]
    else:
        config = changed(SITE, change)
    ran = plan(ctl, tmp_path, config)
    assert ran.code == 0
    (warning,) = [line for line in ran.out.splitlines() if words in line]
    assert warning.startswith("warning: ")


def test_a_head_that_turns_the_target_out_of_its_image_is_warned_of(
    ctl: Ctl, tmp_path: Path
) -> None:
    reported = planned(ctl, tmp_path, SITE, "--reach-deg", "0.4", "0.1")
    assert any(
        "the main target leaves its image at 6 of 21" in text for text in reported["warnings"]
    )


def test_a_drift_that_the_main_image_cannot_hold_is_warned_of(ctl: Ctl, tmp_path: Path) -> None:
    reported = planned(ctl, tmp_path, SITE + "\n[quality]\nexpected_drift_mrad = 2.9\n")
    (warning,) = reported["warnings"]
    assert "moves the main target by 33 mm" in warning
    assert "shorter main lens" in warning


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ([("focal_length_mm = 800.0", "focal_length_mm = 4000.0")], "main target: 1 of 5 discs"),
        ([("[quality]", "[quality]\nexpected_drift_mrad = 6.0")], "expected drift"),
    ],
    ids=["main", "drift"],
)
def test_a_site_that_cannot_be_calibrated_is_exit_1_with_the_cause(
    ctl: Ctl, tmp_path: Path, changes: list[tuple[str, str]], words: str
) -> None:
    """Scales and room are reported all the same."""
    config = changed(SITE + "\n[quality]\n", *changes)
    ran = plan(ctl, tmp_path, config, "--json")
    assert ran.code == 1
    reported = json.loads(ran.out)
    assert reported["predicted"] is None
    assert words in reported["failure"]
    assert reported["main_px_per_mm"] > 0.0
    ran = plan(ctl, tmp_path, config)
    assert ran.code == 1
    assert "field of view" in ran.out
    (error,) = ran.err.splitlines()
    assert reported["failure"] in error


def test_a_head_that_only_pans_is_exit_1_and_names_the_missing_motion(
    ctl: Ctl, tmp_path: Path
) -> None:
    ran = plan(ctl, tmp_path, SITE, "--reach-deg", "0.2", "0")
    assert ran.code == 1
    assert "missing motion: tilt" in ran.err


def test_a_missing_config_is_exit_3(ctl: Ctl, tmp_path: Path) -> None:
    ran = ctl("--config", tmp_path / "none.toml", "plan")
    assert ran.code == 3
    assert len(ran.err.splitlines()) == 1


def test_programs_compute_with_one_thread() -> None:
    """Threads that spin for one another cost a loaded computer far more than they bring."""
    code = "import daemon, numpy, scipy.linalg, os; print(len(os.listdir('/proc/self/task')))"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "1"
