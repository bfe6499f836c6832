"""What `[simulation]` says of climate, breathing and plates reaches the simulated rig."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.config.reading import load_config
from daemon.errors import ConfigError
from drivers.sim.settings import Breathing, Climate, SimPlate, SimSettings
from tests.laboratory import laboratory

PLATE = """
[[target.extra]]
name = "abutment"
role = "fixed"
kind = "circles"
centres_mm = [[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]]
diameter_mm = 8.0
distance_mm = 11500.0
distance_sigma_mm = 20.0
"""
CLIMATE = Climate(10.0, 6.0, 12.0, 2.0, 4.0, 14.0, 1.5, 21.0, 19.0, 0.1)
BREATHING = Breathing(
    (2.0, 1.0, 0.5), (1.7, 1.6, 1.5), (0.02, -0.01), 70.0, (0.01, 0.03), 60.0,
    (0.5, 0.4, 0.3), (0.2, 0.1, 0.3), (0.0, 64.0), 0.1,
)  # fmt: skip
MOVES = SimPlate(
    "abutment", (90.0, 5.0), 0.1, 60.0, (0.3, -0.2), 0.01, ((30.0, 60.0), (90.0, 95.0))
)


def _section(name: str, values: object) -> str:
    """A table with every field of a settings dataclass, in TOML."""
    lines = [f"{key} = {_toml(getattr(values, key))}" for key in values.__slots__]
    return "\n".join([name, *lines, ""])


def _toml(value: object) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(item) for item in value) + "]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _config(tmp_path: Path, *tables: str) -> Path:
    path = tmp_path / "dcam.toml"
    path.write_text(laboratory(640) + "".join(tables))
    return path


def test_every_key_reaches_the_rig(tmp_path: Path) -> None:
    """Field by field, under the same names; without the tables a rig is as it always was."""
    tables = (
        PLATE,
        _section("[simulation.climate]", CLIMATE),
        _section("[simulation.breathing]", BREATHING),
        _section("[[simulation.plates]]", MOVES),
    )
    settings = load_config(_config(tmp_path, *tables)).simulation.settings()
    assert settings.climate == CLIMATE
    assert settings.breathing == BREATHING
    assert settings.plates == (MOVES,)
    assert settings.breathes
    assert load_config(_config(tmp_path)).simulation.settings() == SimSettings()


@pytest.mark.parametrize(
    ("plates", "message"),
    [
        ('name = "pylon"', r'plates\[0\].name: "pylon" is no plate of .*; there: "abutment"'),
        (
            'name = "abutment"\n[[simulation.plates]]\nname = "abutment"',
            r'plates\[1\].name: "abutment" has a table already; put them together',
        ),
        (
            'name = "abutment"\nhidden_min = [[60.0, 30.0]]',
            r"plates\[0\].hidden_min: each span from .* to a later one, is \[60, 30\]",
        ),
        ('name = "abutment"\noffset = [1.0, 2.0]', r"plates\[0\].offset: unknown key; .*offset_mm"),
    ],
)
def test_what_is_wrong_with_a_plate_is_said(tmp_path: Path, plates: str, message: str) -> None:
    """One line with the key."""
    with pytest.raises(ConfigError, match=message):
        load_config(_config(tmp_path, PLATE, "[[simulation.plates]]\n", plates))
