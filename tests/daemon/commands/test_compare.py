"""`dcam-ctl compare` and `--reference`: a survey beside the record, or clear words why not."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from core.results import Displacement, Flag
from core.site import TargetRole
from tests.daemon.commands.conftest import GOOD, Site
from tests.daemon.store.examples import FIXED

HEADER = "time,x_mm,y_mm,sigma_mm"
LINES = (
    "2026-03-01T00:02:00Z,10.5,8.65,0.1",
    "2026-03-01T01:04:00+01:00,10.5,8.85,0.1",
    "2026-03-01T00:07:30Z,10.5,8.75,0.1",
)
"""Zeros of their own, 10 mm to the right and up; the rows are x 0.5 (0.1), y -1.25 (0.2)."""


def reference(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "survey.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_a_survey_is_compared_with_free_and_with_fixed_zero(site: Site, tmp_path: Path) -> None:
    survey = reference(tmp_path, HEADER, *LINES)
    ran = site.ctl("compare", "--reference", survey, "--json")
    assert (ran.code, ran.err) == (0, "")
    x, y = json.loads(ran.out)["points"]
    assert (x["point"], x["axis"], y["axis"]) == ("main", "x", "y")
    found = y["comparison"]
    assert found["offset_mm"] == pytest.approx(-10.0)
    assert [one["difference_mm"] for one in found["differences"]] == pytest.approx([0.1, -0.1, 0.0])
    assert found["agrees"] is True
    # A difference's sigma is that of both, less what the free zero takes: two thirds of it.
    sigma_mm = (2.0 / 3.0 * (0.2**2 + 0.1**2)) ** 0.5
    assert found["differences"][0]["sigma_mm"] == pytest.approx(sigma_mm)
    assert found["differences"][0]["e_n"] == pytest.approx(0.1 / (2.0 * sigma_mm))
    fixed = site.ctl("compare", "--reference", survey, "--zero", "fixed")
    assert "do NOT agree within their uncertainties" in fixed.out
    assert "mean -10.000 mm, both count from one zero" in fixed.out


def test_another_program_writes_it_with_semicolons_and_decimal_commas(
    site: Site, tmp_path: Path
) -> None:
    path = tmp_path / "survey.csv"
    text = "# levelling\r\n\r\nTime;y_mm;sigma_y_mm;remark\r\n"
    text += "2026-03-01T00:02:00Z;-1,15;0,1;by hand, in rain\r\n"
    path.write_bytes(b"\xef\xbb\xbf" + text.encode())
    ran = site.ctl("compare", "--reference", path, "--zero", "fixed", "--json")
    assert ran.code == 0, ran.err
    (y,) = json.loads(ran.out)["points"]
    assert y["comparison"]["bias_mm"] == pytest.approx(-0.1)


def test_a_further_target_is_compared_by_its_name(site: Site, tmp_path: Path) -> None:
    there = Displacement(np.array([0.0, 4.0]), np.diag([0.01, 0.01]))
    target = replace(
        FIXED,
        name="quarter-span",
        role=TargetRole.MEASURED,
        flag=Flag.GOOD,
        reasons=(),
        corrected=there,
    )
    site.measure(3, replace(GOOD, targets=(target,)))
    survey = reference(
        tmp_path, "time,y_mm,sigma_mm,point", "2026-03-01T00:11:00Z,3.9,0.1,quarter-span"
    )
    ran = site.ctl("compare", "--reference", survey, "--zero", "fixed", "--json")
    assert ran.code == 0, ran.err
    (one,) = json.loads(ran.out)["points"]
    assert (one["point"], one["comparison"]["bias_mm"]) == ("quarter-span", pytest.approx(0.1))
    wrong = reference(tmp_path, "time,y_mm,sigma_mm,point", "2026-03-01T00:11:00Z,3.9,0.1,mid")
    ran = site.ctl("compare", "--reference", wrong)
    assert ran.code == 1
    assert 'names the point "mid"; there are main, quarter-span' in ran.err


def test_what_the_ledger_excludes_does_not_move_the_bias(site: Site, tmp_path: Path) -> None:
    begin = site.end
    moved = Displacement(np.array([0.5, 9.0]), np.diag([0.01, 0.04]))
    site.measure(2, replace(GOOD, corrected=moved))
    span = ("--since", begin.isoformat(), "--until", site.end.isoformat())
    site.measure(2)
    middle = (begin + (site.end - begin) / 2).isoformat()
    survey = reference(tmp_path, "time,y_mm,sigma_mm", f"{middle},-1.25,0.1")
    compared = ("compare", "--reference", survey, "--zero", "fixed")
    ran = site.ctl("ledger", "exclude", *span, "--by", "Eve", "scaffold moved")
    assert ran.code == 0, ran.err

    (y,) = json.loads(site.ctl(*compared, "--json").out)["points"]
    assert y["comparison"]["bias_mm"] == pytest.approx(0.0)
    assert y["excluded"] == {"rows": 2, "spans": 1, "left_out": True}
    (y,) = json.loads(site.ctl(*compared, "--json", "--with-excluded").out)["points"]
    assert y["comparison"]["bias_mm"] > 1.0
    assert y["excluded"] == {"rows": 2, "spans": 1, "left_out": False}
    said = "main y: quality ledger: 2 good rows in 1 excluded span"
    assert f"{said} left out\n" in site.ctl(*compared).out
    assert f"{said} taken in\n" in site.ctl(*compared, "--with-excluded").out

    everything = ("--since", "2026-01-01T00:00Z", "--until", "2027-01-01T00:00Z")
    assert site.ctl("ledger", "exclude", *everything, "--by", "Eve", "loose").code == 0
    ran = site.ctl(*compared)
    assert (ran.code, ran.out) == (1, "")
    assert "--with-excluded takes them in" in ran.err


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ((), "empty; the first line names the columns"),
        ((HEADER,), "no line with a value"),
        (("when,y_mm,sigma_mm", "2026-03-01T00:02:00Z,1,1"), 'unknown column "when"'),
        (("time,sigma_mm", "2026-03-01T00:02:00Z,1"), "needs the columns time and x_mm or y_mm"),
        (("time,y_mm", "2026-03-01T00:02:00Z,1"), "y_mm has no uncertainty; add a column"),
        ((HEADER, "2026-03-01T00:02:00,1,1,1"), 'line 2: "2026-03-01T00:02:00" has no zone'),
        ((HEADER, "1 March,1,1,1"), 'line 2: "1 March" is not a time'),
        ((HEADER, "2026-03-01T00:02:00Z,one,1,1"), 'line 2: x_mm: "one" is not a number'),
        ((HEADER, "2026-03-01T00:02:00Z,1,nan,1"), 'line 2: y_mm: "nan" is not a number'),
        ((HEADER, "2026-03-01T00:02:00Z,1,1,0"), "a standard uncertainty is more than 0"),
        ((HEADER, "2026-03-01T00:02:00Z,1,1,"), "line 2: x_mm has no uncertainty"),
        ((HEADER, "2026-03-01T00:02:00Z,,,1"), "line 2: neither x_mm nor y_mm has a value"),
        ((HEADER, "2026-03-01T00:02:00Z,1,5,1,5,0"), "line 2: 6 cells, but 4 columns are named"),
        ((HEADER, "2030-03-01T00:02:00Z,1,1,1"), "no good row within 300 s of any of its times"),
    ],
)
def test_what_is_no_reference_is_said_in_one_line(
    site: Site, tmp_path: Path, lines: tuple[str, ...], said: str
) -> None:
    ran = site.ctl("compare", "--reference", reference(tmp_path, *lines))
    assert (ran.code, ran.out) == (1, "")
    assert said in ran.err
    assert len(ran.err.splitlines()) == 1


def test_a_file_that_is_not_there_is_said_in_one_line(site: Site, tmp_path: Path) -> None:
    for command in ("compare", "plot --output a.svg"):
        ran = site.ctl(*command.split(), "--reference", tmp_path / "none.csv")
        assert ran.code == 4
        assert re.search(r"none\.csv: No such file", ran.err)


def test_a_figure_shows_the_reference_with_error_bars_in_the_records_zero(
    site: Site, tmp_path: Path
) -> None:
    survey = reference(tmp_path, HEADER, *LINES)
    assert site.ctl("plot", "--reference", survey, "--output", tmp_path / "a.svg").code == 0
    drawn = (tmp_path / "a.svg").read_text()
    assert drawn.count("<!-- reference (k = 2) -->") == 2  # in x and in y
    assert 'id="LineCollection_' in drawn  # the bars
    assert ET.parse(tmp_path / "a.svg").getroot().tag.endswith("svg")
    assert site.ctl("plot", "--output", tmp_path / "b.svg").code == 0
    without = (tmp_path / "b.svg").read_text()
    assert "reference (k" not in without
    assert "LineCollection_" not in without
