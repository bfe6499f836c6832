"""A config loads as documented, from where it is found, and its hash is of what measures."""

import re
from pathlib import Path

import numpy as np
import pytest

from daemon.config.reading import find_installation, load_config
from daemon.errors import ConfigError
from tests.daemon.config.conftest import problems_of


def test_minimal_site_becomes_the_core_s_site(write) -> None:
    site = load_config(write()).site()
    assert site.main.focal_px == pytest.approx(800_000 / 5.86)
    assert site.main_target.centres_mm.shape == (5, 2)
    assert site.main_target.diameters_mm.tolist() == [8.0] * 5
    assert (site.sub_target.squares_x, site.sub_target.squares_y) == (32, 31)
    np.testing.assert_array_equal(site.rig.offset_main_sub_mm, [0.0, 0.0, -80.0])
    assert site.quality.max_skew_ms == 20.0


def test_the_lens_model_is_chosen_unless_named(write) -> None:
    assert load_config(write()).site().lens_model is None
    reported = ("focal_length_mm = 6.0", 'focal_length_mm = 6.0\nlens_model = "fisheye"')
    assert load_config(write(reported)).site().lens_model == "fisheye"


def test_a_lens_model_is_the_sub_camera_s_and_known(write) -> None:
    wrong = ("focal_length_mm = 6.0", 'focal_length_mm = 6.0\nlens_model = "thin"')
    (problem,) = problems_of(write(wrong))
    assert problem.startswith("camera.sub.lens_model: ")
    assert "'fisheye'" in problem
    main = ("focal_length_mm = 800.0", 'focal_length_mm = 800.0\nlens_model = "brown"')
    (problem,) = problems_of(write(main))
    assert problem.startswith("camera.main.lens_model: unknown key")


def test_whole_numbers_may_be_written_without_a_point(write) -> None:
    assert load_config(write(("distance_mm = 11000.0", "distance_mm = 11000"))).site()


def test_each_disc_may_have_its_own_diameter(write) -> None:
    path = write(("diameter_mm = 8.0", "diameter_mm = [8, 8, 6.5, 8, 8]"))
    assert load_config(path).site().main_target.diameters_mm.tolist() == [8, 8, 6.5, 8, 8]


def test_a_byte_order_mark_is_no_part_of_the_config(write) -> None:
    path = write()
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert load_config(path).name == "pier-3"


def test_hash_is_of_what_measures_and_not_of_how_it_is_written(write) -> None:
    known = load_config(write()).config_hash()
    assert re.fullmatch(r"[0-9a-f]{64}", known)
    for change in [
        ("distance_mm = 11000.0", "distance_mm = 11_000"),
        ("diameter_mm = 8.0", "diameter_mm = [8, 8, 8, 8, 8]"),
        ("[rig]", "[schedule]\nperiod_s = 30\n[storage]\ndirectory = '/data'\n[rig]"),
        ("[rig]", "[quality]\nmax_sigma_mm = 0.5\n[rig]"),
    ]:
        assert load_config(write(change)).config_hash() == known
    for change in [
        ("distance_mm = 50.0", "distance_mm = 50.1"),
        ("[rig]", "[quality]\nmax_sigma_mm = 0.4\n[rig]"),
    ]:
        assert load_config(write(change)).config_hash() != known


def test_short_period_shortens_how_late_a_slot_may_be(write) -> None:
    schedule = load_config(write(extra="[schedule]\nperiod_s = 1")).schedule.schedule()
    assert schedule.max_late_s == 0.5


def test_flag_before_environment_before_file_before_default(write, tmp_path: Path) -> None:
    path = write(extra='[storage]\ndirectory = "data"')
    environ = {"DCAM_CONFIG": str(path), "DCAM_STATE": "/from/environment"}

    assert find_installation(None, Path("/from/flag"), environ).state_directory == Path(
        "/from/flag"
    )
    assert find_installation(None, None, environ).state_directory == Path("/from/environment")
    assert find_installation(path, None, {}).state_directory == tmp_path / "data"
    assert find_installation(path, None, {"DCAM_STATE": ""}).state_directory == tmp_path / "data"
    assert find_installation(write(), None, {}).state_directory == Path("/var/lib/dcam")

    other = tmp_path / "other.toml"
    with pytest.raises(ConfigError, match=r"other\.toml: no such file"):
        find_installation(other, None, environ)
    with pytest.raises(ConfigError, match=r"/etc/dcam/dcam\.toml: no such file"):
        find_installation(None, None, {})
