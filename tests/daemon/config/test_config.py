"""A config loads as documented; whatever is wrong with one is said in one line with its key."""

import re
from pathlib import Path

import numpy as np
import pytest

from daemon.config.reading import find_installation, load_config
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


def test_every_mistake_is_reported_at_once(write) -> None:
    path = write(("distance_mm = 50.0", "distance_cm = 5.0"), ("squares_x = 32", "squares_x = 0"))
    assert len(problems_of(path)) == 2


@pytest.mark.parametrize(
    ("extra", "expected"),
    [
        ("[schedule]\nperiod_s = 0", "schedule.period_s: must be at least 1"),
        ("[schedule]\nperiod_s = 0.5", "schedule.period_s: must be a whole number"),
        ("[schedule]\noffset_s = 60", "schedule.offset_s: must be less than period_s = 60"),
        ("[schedule]\nmax_late_s = 0", "schedule.max_late_s: must be greater than 0"),
        (
            "[schedule]\nburst = 3\nburst_spacing_s = 0.004",
            "schedule.burst_spacing_s: must be longer than the exposure of 0.005 s, is 0.004",
        ),
        (
            "[schedule]\nburst = 32\nburst_spacing_s = 1.0",
            "schedule.burst: 32 pairs 1 s apart may take 33 s .* have half of period_s = 60",
        ),
        (
            "[schedule]\nburst = 29\n[exposure]\nmode = 'auto'\nmain_limits_us = [50.0, 1.9e6]",
            "schedule.burst_spacing_s: must be longer than the exposure of 1.9 s, is 0.5",
        ),
        (
            '[pan_tilt]\nport = "tcp://10.0.0.3:4000"',
            r'pan_tilt.port: "tcp://10.0.0.3:4000" has no way .* socket://HOST:PORT or rfc2217://',
        ),
        (
            '[pan_tilt]\nport = "socket://10.0.0.3"',
            "pan_tilt.port: .* needs host and port number, as socket://192.168.1.20:4000",
        ),
        (
            '[pan_tilt]\nport = "rfc2217://10.0.0.3:99999"',
            "pan_tilt.port: .* needs host and port number, as rfc2217://",
        ),
        (
            '[pan_tilt]\nport = "rfc2217://10.0.0.3:4000?logging=debug"',
            "pan_tilt.port: .* says more than host and port number",
        ),
        (
            "[pan_tilt]\npan_limits_deg = [5.0, -5.0]",
            r"pan_tilt.pan_limits_deg: the lower limit first, is \[5, -5\]",
        ),
        (
            "[pan_tilt]\nhome_deg = [1.0, 7.0]",
            r"pan_tilt.home_deg: tilt 7 is not within tilt_limits_deg = \[-5, 5\]",
        ),
        ("[exposure]\nmain_us = 0.005", "exposure.main_us: .* is this in milliseconds"),
        ("[exposure]\nsub_us = 3e6", r"exposure: 3e\+06 us are not over within trigger.timeout_s"),
        ("[exposure]\nwhite_level = 0.9", r"exposure.white_level: must be at most 0\.75"),
        (
            "[exposure]\nmode = 'auto'\nmain_us = 20.0",
            r"exposure.main_us: 20 is not within main_limits_us = \[50, 100000\]",
        ),
        (
            "[exposure]\nmode = 'auto'\nmain_gain_db = 20.0",
            r"exposure.main_gain_db: 20 is not within main_gain_limits_db = \[0, 12\]",
        ),
        (
            "[exposure]\nmode = 'auto'\nsub_limits_us = [9e4, 50.0]",
            "exposure.sub_limits_us: the lower limit first",
        ),
        (
            "[exposure]\nmode = 'auto'\nsub_gain_limits_db = [3.0, 1.0]",
            "exposure.sub_gain_limits_db: the lower limit first",
        ),
        (
            "[exposure]\nmode = 'auto'\nsub_limits_us = [50.0, 3e6]",
            r"exposure: 3e\+06 us are not over within trigger.timeout_s = 2",
        ),
        ("[log]\nlevel = 'loud'", "log.level: must be one of"),
        ("[storage]\ndir = '/tmp'", "storage.dir: unknown key; did you mean storage.directory"),
        (
            "[simulation]\nstart_utc = 2026-03-01T00:00:00",
            "simulation.start_utc: must be a time in",
        ),
        ("[simulation]\nstart_utc = 'noon'", "simulation.start_utc: must be a time in UTC such as"),
        (
            "[[simulation.scenarios]]\nkind = 'fog'",
            r"simulation.scenarios\[0\].kind: must be one of .*'snow'",
        ),
        (
            "[[simulation.scenarios]]\nkind = 'snow'\nstart_m = 3",
            r"simulation.scenarios\[0\].start_m: unknown key; did you mean .*\.start_min",
        ),
        (
            "[[simulation.scenarios]]\nkind = 'snow'\nstart_min = 3\nend_min = 3",
            r"simulation.scenarios\[0\].end_min: must be greater than start_min = 3, is 3",
        ),
        (
            "[simulation]\nbridge_course = [[5.0, 0.0], [5.0, -6.5]]",
            "simulation.bridge_course: each point must be later than the one before",
        ),
        ("[wifi]\nport = 80", "wifi: unknown key; known here"),
        ("[web]\nhost = 'pier'", 'web.host: "pier" is no address; write "127.0.0.1"'),
        ("[web]\ntoken = 'short'", "web.token: must have at least 16 characters"),
        (
            "[web]\nhost = '0.0.0.0'\nhosts = ['pier-3']",
            "web.token: missing; whoever reaches 0.0.0.0 could look",
        ),
        (
            "[web]\nhost = '::'\ntoken_file = 'token'",
            "web.hosts: missing; list the names or addresses",
        ),
        ("[web]\nhosts = ['a b']", "web.hosts.*not shown"),
    ],
)
def test_optional_sections_are_checked_as_well(write, extra: str, expected: str) -> None:
    (problem,) = problems_of(write(extra=extra))
    assert re.match(expected, problem), problem


def test_file_that_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "none.toml"
    assert problems_of(path)[0].startswith("no such file; name one with --config")
    path.write_bytes(b'[site]\nname = "\xff"\n')
    assert "not UTF-8" in problems_of(path)[0]
    path.unlink()
    path.mkdir()
    assert "it is a directory: name a file" in problems_of(path)[0]


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
