"""`--tz`: people read and give local time, with its offset; programs get UTC all the same."""

from __future__ import annotations

import csv
import json
import os
from datetime import UTC, datetime
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from daemon.store.records import GapCause
from tests.daemon.commands.conftest import Ctl, Site
from tests.programs import ran as ran_program

BERLIN = "Europe/Berlin"
SPRING = datetime(2026, 3, 29, 0, 55, tzinfo=UTC)
"""Five minutes before clocks in Berlin go forward, from 02:00 to 03:00."""
AUTUMN = datetime(2026, 10, 25, 0, 55, tzinfo=UTC)
"""Five minutes before clocks in Berlin go back, from 03:00 to 02:00."""


@pytest.fixture
def spring(site: Site) -> Site:
    """A site with rows and gaps around the hour that is skipped and the one that is twice."""
    for start in (SPRING, AUTUMN):
        site.end = start
        site.measure(4)
        site.miss(2, GapCause.OVERRUN)
        site.measure(4)
    return site


def test_gaps_are_in_the_zone_with_the_offset_of_their_day(spring: Site) -> None:
    ran = spring.ctl("gaps", "--tz", BERLIN)
    assert ran.code == 0, ran.err
    first, second = (line.split()[:2] for line in ran.out.splitlines()[1:3])
    assert first == ["2026-03-29T01:59:00+01:00", "2026-03-29T03:00:00+02:00"]
    assert second == ["2026-10-25T02:59:00+02:00", "2026-10-25T02:00:00+01:00"]


def test_json_stays_utc(spring: Site) -> None:
    ran = spring.ctl("gaps", "--tz", BERLIN, "--json")
    assert json.loads(ran.out)["gaps"][0]["start_utc"] == "2026-03-29T00:59:00Z"
    at = "2026-10-25T01:05:00Z"
    items = json.loads(spring.ctl("status", "--tz", BERLIN, "--json", "--at", at).out)["items"]
    assert "(2026-10-25T01:04:00Z)" in items[0]["text"]


def test_status_tells_every_time_in_the_zone_of_the_config(spring: Site) -> None:
    text = spring.config.read_text()
    spring.config.write_text(text.replace("[site]", f'[site]\ntimezone = "{BERLIN}"', 1))
    ran = spring.ctl("status", "--at", "2026-10-25T01:05:00Z")
    assert "as of 2026-10-25T02:05:00+01:00" in ran.out
    assert "(2026-10-25T02:04:00+01:00)" in ran.out
    assert "Z)" not in ran.out
    assert "(2026-10-25T01:04:00Z)" in spring.ctl("status", "--tz", "UTC").out


def test_a_time_that_is_given_without_an_offset_is_in_the_zone(spring: Site) -> None:
    """What is printed can be given back, and a local day begins at local midnight."""
    since = ["--since", "2026-10-25T02:59", "--until", "2026-10-25T02:00:00+01:00"]
    ran = spring.ctl("gaps", "--tz", BERLIN, *since)
    assert "1 gap, 2 slots missed" in ran.out
    assert "is later than" in spring.ctl("gaps", *since).err  # 02:59 UTC is
    other_order = spring.ctl("gaps", *since, "--tz", BERLIN)
    assert other_order.out == ran.out


def test_the_plain_table_is_for_a_spreadsheet(spring: Site, tmp_path: Path) -> None:
    table = tmp_path / "plain.csv"
    spring.ctl("export", "--format", "csv-plain", "--tz", BERLIN, "--output", table)
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [
        *("local_time", "utc_offset", "x_mm", "y_mm", "sigma_x_mm", "sigma_y_mm", "quality"),
        *("reasons", "main_temperature_c"),
    ]
    by_time = [(row["local_time"], row["utc_offset"]) for row in rows[10:]]
    assert by_time[3:7] == [
        ("2026-03-29 01:58:00", "+01:00"),
        ("2026-03-29 01:59:00", "+01:00"),
        ("2026-03-29 03:00:00", "+02:00"),
        ("2026-03-29 03:01:00", "+02:00"),
    ]
    assert len(set(by_time)) == len(by_time) == 20
    assert rows[10]["x_mm"] == "0.5000"
    assert (rows[10]["quality"], rows[10]["reasons"]) == ("good", "")
    gap = rows[14]
    assert (gap["x_mm"], gap["quality"], gap["reasons"]) == ("", "missing", "overrun")


def test_decimal_commas_come_with_semicolons(spring: Site) -> None:
    ran = spring.ctl("export", "--format", "csv-plain", "--decimal", "comma")
    lines = ran.out.splitlines()
    assert lines[1] == "2026-03-01 00:00:00;+00:00;0,5000;-1,2500;0,1000;0,2000;good;;"
    assert "csv-plain" in spring.ctl("export", "--decimal", "comma").err


def test_the_table_for_programs_stays_utc(spring: Site) -> None:
    assert spring.ctl("export", "--tz", BERLIN).out == spring.ctl("export").out


def test_the_report_and_the_figure_name_their_zone(spring: Site, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    page, figure = tmp_path / "page.html", tmp_path / "figure.svg"
    since = ["--since", "2026-10-25T00:00:00Z", "--tz", BERLIN]
    assert spring.ctl("report", *since, "--output", page).code == 0
    text = page.read_text()
    assert "2026-10-25T02:59:00+02:00" in text
    assert f"times: {BERLIN}" in text
    assert spring.ctl("plot", *since, "--output", figure).code == 0
    assert f"<!-- {BERLIN} -->" in figure.read_text()


@pytest.mark.parametrize(
    ("named", "said"),
    [
        ("Berlin", '"Europe/Berlin"'),
        ("Europe/Berln", '"Europe/Berlin"'),
        ("Europe", "is no IANA time zone"),
        ("../../etc/passwd", "is no IANA time zone"),
        ("CEST", "is no IANA time zone"),
    ],
)
def test_a_zone_that_there_is_not_is_named_in_one_line(site: Site, named: str, said: str) -> None:
    ran = site.ctl("gaps", "--tz", named)
    assert ran.code == 2
    assert said in ran.err
    site.config.write_text(
        site.config.read_text().replace("[site]", f'[site]\ntimezone = "{named}"')
    )
    told = site.ctl("status")
    assert "site.timezone" in told.out
    assert said in told.out


def local_gaps(site: Site, zone: str) -> CompletedProcess[str]:
    """`gaps --tz local` on a computer with this `TZ`."""
    words = ("--config", site.config, "--state", site.state, "gaps", "--tz", "local")
    return ran_program("daemon.ctl", *words, env={**os.environ, "TZ": zone})


def test_the_zone_of_this_computer(spring: Site) -> None:
    assert "2026-10-25T11:59:00+11:00" in local_gaps(spring, "Australia/Sydney").stdout


def test_a_computer_whose_zone_has_no_name_says_so_in_one_line(spring: Site) -> None:
    ran = local_gaps(spring, "CET-1CEST,M3.5.0,M10.5.0/3")
    assert ran.returncode == 2
    assert "give a name such as Europe/Berlin" in ran.stderr
    assert "Traceback" not in ran.stderr


def test_an_alarm_is_sent_although_the_zone_is_wrong(tmp_path: Path, ctl: Ctl) -> None:
    config, mail = tmp_path / "dcam.toml", tmp_path / "mail"
    config.write_text(
        '[site]\nname = "pier"\ntimezone = "Nowhere/Land"\n'
        f'[alarm]\ncommand = ["cp", "/dev/stdin", "{mail}"]\nafter_min = 0\n'
    )
    (tmp_path / "state").mkdir()
    ran = ctl("--config", config, "--state", tmp_path / "state", "alarm")
    assert ran.code == 0, ran.err
    assert "times are UTC" in ran.err
    assert mail.exists()
