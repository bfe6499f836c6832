"""The smallest config, with pieces of it replaced."""

from pathlib import Path

import pytest

from daemon.config.reading import load_config
from daemon.errors import ConfigError

MINIMAL = """
[site]
name = "pier-3"

[camera.main]
width_px = 1920
height_px = 1200
pixel_pitch_um = 5.86
focal_length_mm = 800.0

[camera.sub]
width_px = 1920
height_px = 1200
pixel_pitch_um = 5.86
focal_length_mm = 6.0

[target.main]
kind = "circles"
centres_mm = [[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]]
diameter_mm = 8.0
distance_mm = 11000.0
distance_sigma_mm = 20.0

[target.sub]
kind = "checkerboard"
squares_x = 32
squares_y = 31
square_mm = 2.0
distance_mm = 50.0

[rig]
rotation_main_sub_deg = [0.0, 180.0, 0.0]
rotation_sigma_deg = 1.0
offset_main_sub_mm = [0.0, 0.0, -80.0]
offset_sigma_mm = 3.0
"""


@pytest.fixture
def write(tmp_path: Path):
    """Write the minimal site, with pieces replaced, and give its path."""

    def write(*changes: tuple[str, str], extra: str = "") -> Path:
        text = MINIMAL
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / "dcam.toml"
        path.write_text(text + extra)
        return path

    return write


def problems_of(path: Path) -> tuple[str, ...]:
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    for problem in caught.value.problems:
        assert problem.startswith(f"{path}: ")
        assert "\n" not in problem
    return tuple(problem.removeprefix(f"{path}: ") for problem in caught.value.problems)
