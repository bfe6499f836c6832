"""Whatever is wrong with a config is said in one line with its key, and without its secrets."""

import re
from pathlib import Path

import pytest

from daemon.config.reading import load_config
from daemon.errors import ConfigError
from tests.daemon.config.conftest import problems_of

WRONG = [
    # wrong unit in the key: the nearest known name
    (
        "distance_mm = 11000.0",
        "distance_m = 11.0",
        "target.main.distance_m: unknown key; did you mean target.main.distance_mm?",
    ),
    (
        "pixel_pitch_um = 5.86",
        "pixel_pitch_mm = 0.00586",
        "camera.main.pixel_pitch_mm: unknown key; did you mean camera.main.pixel_pitch_um?",
    ),
    ("[site]", "[sight]", "sight: unknown key; did you mean site?"),
    (
        "squares_x = 32",
        "squares_x = 32\nsquare_x = 32",
        "target.sub.square_x: unknown key; did you mean target.sub.squares_x?",
    ),
    (
        'name = "pier-3"',
        'name = "pier-3"\nperiod_s = 60',
        "site.period_s: unknown key; did you mean schedule.period_s?",
    ),
    ("[site]", "[zzz]\na = 1\n[site]", "zzz: unknown key; known here: site, camera, target"),
    # wrong unit in the value: the likely unit
    (
        "distance_mm = 11000.0",
        "distance_mm = 11.0",
        "target.main.distance_mm: 11 mm is nearer than .* is this in metres",
    ),
    (
        "distance_mm = 50.0",
        "distance_mm = 0.05",
        "target.sub.distance_mm: .* is this in metres",
    ),
    (
        "focal_length_mm = 6.0",
        "focal_length_mm = 60.0",
        "target.sub.distance_mm: 50 mm is nearer than .* 60 mm; .*, or camera.sub.focal_length_mm$",
    ),
    (
        "distance_mm = 11000.0",
        "distance_mm = 1.1e7",
        "target.main.distance_mm: must be at most .* is this in micrometres",
    ),
    (
        "focal_length_mm = 800.0",
        "focal_length_mm = 0.8",
        "camera.main.focal_length_mm: .* is this in metres",
    ),
    (
        "pixel_pitch_um = 5.86",
        "pixel_pitch_um = 0.00586",
        "camera.main.pixel_pitch_um: .* is this in millimetres",
    ),
    ("square_mm = 2.0", "square_mm = 0.02", "target.sub.square_mm: .* is every unit right"),
    ("diameter_mm = 8.0", "diameter_mm = 0.08", "target.main.diameter_mm: .* is every unit right"),
    ("[-15.0, 11.0]", "[-500.0, 11.0]", "target.main.centres_mm: .* is every unit right"),
    ("[0.0, 180.0, 0.0]", "[0.0, 3.14159, 0.0]", "rig.rotation_main_sub_deg: .* radians"),
    # wrong sign, not finite, wrong type
    (
        "distance_mm = 11000.0",
        "distance_mm = -11000.0",
        r"target.main.distance_mm: must be greater than 0.*, is -11000.0$",
    ),
    ("offset_sigma_mm = 3.0", "offset_sigma_mm = -3.0", "rig.offset_sigma_mm: must be at least"),
    ("offset_sigma_mm = 3.0", "offset_sigma_mm = 0.003", "rig.offset_sigma_mm: .* in metres"),
    ("rotation_sigma_deg = 1.0", "rotation_sigma_deg = 31.0", ".*sigma_deg: must be at most 30"),
    ("rotation_sigma_deg = 1.0", "rotation_sigma_deg = 1e-4", ".*sigma_deg: must be at least"),
    ("sigma_mm = 20.0", "sigma_mm = 0.005", "target.main.distance_sigma_mm: must be at least 0.01"),
    ("sigma_mm = 20.0", "sigma_mm = 20000.0", "target.main.distance_sigma_mm: 20000 mm is more"),
    (
        "[0.0, 0.0, -80.0]",
        "[0.0, 0.0, -0.08]",
        "rig.offset_main_sub_mm: .* 0.08 mm apart, .* is this in metres",
    ),
    # one line only, although the list is too short without the wrong value
    ("diameter_mm = 8.0", "diameter_mm = -8.0", r"target.main.diameter_mm\[0\]: must be greater"),
    ("diameter_mm = 8.0", "diameter_mm = []", "target.main.diameter_mm: must have at least 1"),
    ("distance_mm = 50.0", "distance_mm = nan", "target.sub.distance_mm: must be a finite number"),
    ("180.0", "inf", r"rig.rotation_main_sub_deg\[1\]: must be a finite number, is inf"),
    ("distance_mm = 50.0", 'distance_mm = "50"', "target.sub.distance_mm: must be a number, is"),
    ("squares_x = 32", "squares_x = 31.5", "target.sub.squares_x: must be a whole number"),
    ("squares_x = 32", "squares_x = true", "target.sub.squares_x: must be a whole number"),
    ('name = "pier-3"', "name = 3", "site.name: must be a text in quotes"),
    ('name = "pier-3"', 'name = ""', "site.name: must not be empty"),
    ('"circles"', '"rings"', "target.main.kind: must be one of 'circles', is 'rings'"),
    ("[camera.main]", '[camera.main]\nbackend = "v4l"', "camera.main.backend: must be one of"),
    # what does not fit together
    ("diameter_mm = 8.0", "diameter_mm = [8.0, 8.0]", "target.main.diameter_mm: 2 values for 5"),
    ("diameter_mm = 8.0", "diameter_mm = 40.0", "target.main.centres_mm: discs 1 and 2 overlap"),
    (
        "centres_mm = [[-15.0, 11.0], [15.0, 11.0], [0.0, 0.0], [-15.0, -11.0], [15.0, -11.0]]",
        "centres_mm = [[-15.0, 0.0], [15.0, 0.0], [0.0, 0.0]]",
        "target.main.centres_mm: all discs lie on one line",
    ),
    ("[0.0, 0.0]", "[0.0]", r"target.main.centres_mm\[2\]\[1\]: missing"),
    ("[0.0, 0.0]", "[0.0, 0.0, 0.0]", r"target.main.centres_mm\[2\]: must have at most 2 values"),
    ("distance_mm = 50.0", "", "target.sub.distance_mm: missing"),
    ("[rig]", "[rigg]", "rigg: unknown key; did you mean rig"),
    # not TOML at all
    ("[0.0, 180.0, 0.0]", "[0.0, 180.0", r"not valid TOML: .*line \d+"),
]


@pytest.mark.parametrize(("old", "new", "expected"), WRONG)
def test_one_mistake_is_one_line(write, old: str, new: str, expected: str) -> None:
    (problem,) = problems_of(write((old, new)))
    assert re.match(expected, problem), problem


def test_distances_that_are_swapped_are_said_to_be_so(write) -> None:
    main, sub = ("distance_mm = 11000.0", "distance_mm = 50"), ("= 50.0", "= 11000.0")
    (problem,) = problems_of(write(main, sub))
    assert problem == (
        "target.main.distance_mm: 50 mm and target.sub.distance_mm: 11000 mm fit the lenses only "
        "the other way round; exchange them"
    )


def test_every_mistake_is_reported_at_once(write) -> None:
    path = write(("distance_mm = 50.0", "distance_cm = 5.0"), ("squares_x = 32", "squares_x = 0"))
    assert len(problems_of(path)) == 2


def test_file_that_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    assert problems_of(path)[0].startswith("no such file; name one with --config")
    path.write_bytes(b'[site]\nname = "\xff"\n')
    assert "not UTF-8" in problems_of(path)[0]
    path.unlink()
    path.mkdir()
    assert "it is a directory: name a file" in problems_of(path)[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * 5000 + "]" * 5000, "not valid"),
        ("# " + "x" * 2_000_000, "more than 1000 kB"),
    ],
)
def test_a_file_that_is_no_config_is_refused_in_a_line(
    tmp_path: Path, text: str, words: str
) -> None:
    path = tmp_path / "dcam.toml"
    path.write_text(text)
    (problem,) = problems_of(path)
    assert words in problem


@pytest.mark.parametrize(
    "lines",
    [
        'urls = "ntfy://watch:hunter2@host"',
        'command = "curl -H hunter2"',
        'urls = [["ntfy://watch:hunter2@host"]]',
        'level = "ntfy://watch:hunter2@host"',
        'after_min = "hunter2"',
        '"ntfy://watch:hunter2@host" = true',
        'hunter2 = "ntfy://host"',
        'url = ["ntfy://watch:hunter2@host"]',
    ],
)
def test_no_message_quotes_what_is_in_the_alarm_section(write, lines: str) -> None:
    """Whoever sends a log or asks for help sends no password along."""
    path = write()
    path.write_text(path.read_text() + f"\n[alarm]\n{lines}\n")
    with pytest.raises(ConfigError) as error:
        load_config(path)
    assert "alarm" in str(error.value)
    assert "hunter2" not in str(error.value)


def test_a_url_with_a_password_in_another_place_is_quoted_without_it(write) -> None:
    path = write(('name = "pier-3"', 'name = ["ntfy://watch:hunter2@host"]'))
    with pytest.raises(ConfigError, match=r"site\.name: must be a text") as error:
        load_config(path)
    assert "hunter2" not in str(error.value)
