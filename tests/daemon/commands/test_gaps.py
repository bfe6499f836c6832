"""`dcam-ctl gaps` and `export` list a span of the record beside a daemon that runs."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path

import pytest

from daemon.store.records import GapCause
from tests.daemon.commands.conftest import Ctl, Site


def test_gaps_are_listed_with_slots_and_cause(site: Site) -> None:
    site.miss(3, GapCause.POWER_LOSS)
    site.measure(1)
    site.miss(2, GapCause.CAMERA_LOST)
    ran = site.ctl("gaps", "--json")
    assert ran.code == 0
    document = json.loads(ran.out)
    assert document["schema"] == 1
    assert [(gap["start_utc"], gap["end_utc"]) for gap in document["gaps"]] == [
        ("2026-03-01T00:10:00Z", "2026-03-01T00:12:00Z"),
        ("2026-03-01T00:14:00Z", "2026-03-01T00:15:00Z"),
    ]
    assert [(gap["slots"], gap["cause"]) for gap in document["gaps"]] == [
        (3, "power_loss"),
        (2, "camera_lost"),
    ]
    later = site.ctl("gaps", "--since", "2026-03-01T00:13:00Z")
    assert "power_loss" not in later.out
    assert "1 gap, 2 slots missed" in later.out


def test_no_gaps_is_said(site: Site) -> None:
    assert site.ctl("gaps").out == "no gaps\n"


def test_export_writes_a_span_to_a_file_or_stdout(site: Site, tmp_path: Path) -> None:
    span = ("--since", "2026-03-01T00:02:00Z", "--until", "2026-03-01T00:05:00+00:00")
    ran = site.ctl("export", *span)
    rows = list(csv.DictReader(io.StringIO(ran.out)))
    assert [row["slot_utc"] for row in rows] == [f"2026-03-01T00:0{k}:00Z" for k in (2, 3, 4)]
    assert {row["x_mm"] for row in rows} == {"0.5"}
    assert site.ctl("export", *span, "--output", tmp_path / "out.csv").out == ""
    assert (tmp_path / "out.csv").read_text() == ran.out


@pytest.mark.parametrize("command", ["gaps", "export"])
@pytest.mark.parametrize("order", [1, -1])
def test_a_span_that_ends_before_it_begins_is_a_usage_error(
    site: Site, command: str, order: int
) -> None:
    ends = [("--since", "2026-03-02"), ("--until", "2026-03-01")][::order]
    ran = site.ctl(command, *(word for end in ends for word in end))
    assert (ran.code, ran.out) == (2, "")
    assert "--since 2026-03-02T00:00:00Z is later than --until 2026-03-01T00:00:00Z" in ran.err


def test_an_output_that_cannot_be_made_is_reported_by_its_directory(
    site: Site, tmp_path: Path
) -> None:
    ran = site.ctl("export", "--output", tmp_path / "nowhere" / "out.csv")
    assert ran.code == 4
    assert f"{tmp_path / 'nowhere'}: No such file or directory" in ran.err


def test_a_format_of_a_later_part_is_not_offered(site: Site) -> None:
    assert site.ctl("export", "--format", "parquet").code == 2


def test_a_copied_state_can_be_read_without_its_config(site: Site, ctl: Ctl) -> None:
    assert ctl("--state", site.state, "gaps").code == 0
