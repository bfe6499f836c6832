"""The report for the client, looked at from outside: the HTML, the PDF, and what they say."""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from html.parser import HTMLParser
from pathlib import Path

import pypdfium2
import pytest

from daemon.alarm.history import Happened, note_history
from daemon.config.reading import find_installation, load_config
from daemon.ctl import cli
from daemon.error_report import run
from daemon.main import serve
from daemon.reports.monthly import last_month
from daemon.reports.statement import Statement, make_statement
from daemon.status.item import Level
from daemon.store.database import open_store, open_store_readonly
from daemon.store.ledger.entries import LedgerEntry, LedgerKind
from daemon.store.records import GapCause
from daemon.zones import find_zone
from tests.daemon.commands.conftest import DARK, FURTHER, RUNNING, SIMULATED, START, Ctl, Site
from tests.daemon.store.examples import slot

HOSTILE = '<script>alert(1)</script> & "Brücke" Łódź Δ'
REPORT = """
[report]
client = "Roads <b>Authority</b>"
contact = "Monitoring & Co"
traceability = "plate by rule 4711"
"""


class Cells(HTMLParser):
    """The tables of a page, as text; and the tags that are in it."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.rows: list[list[str]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in {"td", "th"}:
            self.rows[-1].append("")

    def handle_data(self, data: str) -> None:
        if self.rows and self.rows[-1] and self.lasttag in {"td", "th"}:
            self.rows[-1][-1] += data.strip()

    def row(self, first: str) -> list[str]:
        """The cells of the first row that begins so."""
        return next(row for row in self.rows if row and row[0] == first)


def text_of(pdf: Path) -> tuple[str, int]:
    """All text of a PDF in one line, and its pages; each is rendered, so that it can be."""
    with pypdfium2.PdfDocument(pdf) as document:
        pages = list(document)
        for page in pages:
            page.render(scale=0.2).to_numpy()
        text = " ".join(page.get_textpage().get_text_bounded() for page in pages)
    return " ".join(text.split()), len(pages)


def pictures_of(pdf: Path) -> int:
    """How many pictures of pixels a PDF holds."""
    with pypdfium2.PdfDocument(pdf) as document:
        kind = pypdfium2.raw.FPDF_PAGEOBJ_IMAGE
        return sum(len(list(page.get_objects(filter=[kind]))) for page in document)


@pytest.fixture(scope="module")
def measured(further: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibrated site with a fixed plate and five rows of dcamd; it is hidden in the third."""
    directory = tmp_path_factory.mktemp("measured")
    shutil.copytree(further / "state", directory / "state")
    config = directory / "dcam.toml"
    named = re.sub(r'name = "bench"', f"name = '{HOSTILE}'", SIMULATED)
    config.write_text(
        named.replace("[simulation]", f"{FURTHER}\n{REPORT}\n[simulation]") + RUNNING,
        encoding="utf-8",
    )
    serve(find_installation(config, directory / "state"), max_slots=5)
    (directory / "survey.csv").write_text(
        "time,y_mm,sigma_mm\n2026-03-01T00:01:00Z,5.0,0.2\n2026-03-01T00:04:00Z,5.1,0.2\n"
    )
    return directory


@pytest.fixture(scope="module")
def report(measured: Path) -> tuple[Cells, str, Path]:
    """The page's cells, its text and the PDF's path."""
    page, pdf = measured / "a.html", measured / "a.pdf"
    arguments = (
        *("--config", measured / "dcam.toml", "--state", measured / "state", "report"),
        *("--output", page, "--output", pdf, "--trials", 500),
        *("--reference", measured / "survey.csv"),
    )
    assert run(cli, "dcam-ctl", [str(word) for word in arguments]) == 0
    text = page.read_text(encoding="utf-8")
    return Cells(text), text, pdf


def test_html_and_pdf_say_the_same_and_markup_stays_text(report) -> None:
    cells, page, pdf = report
    text, pages = text_of(pdf)
    assert "script" not in cells.tags
    assert "b" not in cells.tags
    assert not re.search(r"(src|href)=\"(?!data:)", page)
    assert pages >= 3
    for fact in (
        HOSTILE,
        "Client: Roads <b>Authority</b>; Contact: Monitoring & Co.",
        "Declared by the operator: plate by rule 4711",
        "This is no calibration certificate.",
        "the two agree within their uncertainties (E_n up to",
        "They agree within 5 %.",
        "Comparison with a reference",
    ):
        assert fact in text, fact
    for fact in ("Roads &lt;b&gt;Authority&lt;/b&gt;", "Statement of uncertainty", "E_n up to"):
        assert fact in page
    assert cells.row("2026-03-01")[1] == "100%"
    assert "y: 0.0 days with enough good rows" in text
    assert page.count("data:image/svg+xml;base64,") == 1
    assert pictures_of(pdf) == 0  # the figure is lines, not pixels


def test_the_budget_is_that_of_the_row(report, measured: Path) -> None:
    """Value, U and u of the table are the database's; the lines' squares add up to u^2."""
    cells, page, _ = report
    found = re.search(r"stands for the span:\s+(\S+?)\.</p>", page)
    assert found is not None
    when = datetime.fromisoformat(found[1])
    with open_store_readonly(measured / "state") as store:
        row = store.measurement(when)
        good = [one for one in store.measurements() if one.measurement.flag == 1]
    assert row is not None
    assert row.measurement.corrected is not None
    sigmas = sorted(max(one.measurement.corrected.covariance_mm2.diagonal()) ** 0.5 for one in good)
    assert max(row.measurement.corrected.covariance_mm2.diagonal()) ** 0.5 == pytest.approx(
        sigmas[(len(sigmas) - 1) // 2]
    )
    for axis, name in enumerate("xy"):
        _, stated, k, coverage, _, u_row, u_budget = cells.row(name)
        sigma_mm = row.measurement.corrected.covariance_mm2[axis, axis] ** 0.5
        assert float(u_row) == pytest.approx(sigma_mm, rel=0.006)
        assert float(u_budget) == pytest.approx(sigma_mm, rel=0.02)
        value, expanded = re.findall(r"[-\d.]+", stated)
        assert float(expanded) == pytest.approx(float(k) * sigma_mm, rel=0.06)
        assert len(expanded.replace(".", "").lstrip("0")) <= 2
        assert len(value.partition(".")[2]) == len(expanded.partition(".")[2])
        assert abs(float(value) - row.measurement.corrected.mm[axis]) <= float(expanded) / 2
        assert coverage == "95.45 %"
    start = next(n for n, one in enumerate(cells.rows) if one[:2] == ["quantity", "estimate"])
    lines = cells.rows[start + 1 :]
    end = next(n for n, one in enumerate(lines) if one[0] == "displacement")
    joint = next(n for n, one in enumerate(lines) if one[0].startswith("calibration: these"))
    independent = [one for one in lines[:joint] if one[4] and not one[0].startswith(CORRELATED)]
    total = sum(float(one[6]) ** 2 for one in (*independent, lines[joint]))
    assert math.sqrt(total) == pytest.approx(float(lines[end][6]), rel=0.06)


def test_a_row_of_a_hidden_plate_has_the_budget_that_it_was_measured_with(
    measured: Path, tmp_path: Path
) -> None:
    """The stability budget's, or a smaller one: then fixed targets had taught how the rig turns."""
    shutil.copytree(measured / "state", tmp_path / "state")
    config = load_config(measured / "dcam.toml")
    with open_store(tmp_path / "state") as store:
        row = list(store.measurements())[2]
        corrected = row.measurement.corrected
        assert corrected is not None
        assert corrected.image_mm2 is not None
        part_mm2 = corrected.covariance_mm2 - corrected.image_mm2
        for minute, share in ((5, 1.2), (6, 0.25)):  # the budget grows from minute 2 on
            whole = replace(corrected, covariance_mm2=corrected.image_mm2 + share * part_mm2)
            measurement = replace(row.measurement, corrected=whole)
            store.add_measurement(replace(row, slot_utc=slot(minute), measurement=measurement))
        lines = []
        for minute in (5, 6):
            found = make_statement(
                store, config.site(), config.config_hash(), slot(minute), trials=0
            )
            assert isinstance(found, Statement)
            assert abs(found.difference).max() < 0.01
            lines.append([one.name for one in found.budget.inputs])
    assert sum("cameras turning" in name for name in lines[0]) == 2
    assert not [name for name in lines[1] if "cameras turning" in name]
    assert "the cameras' turn, as fixed targets had taught it" in lines[1]


CORRELATED = ("lens of", "print and", "reference:", "rotation between", "offset", "distance and")


@pytest.mark.parametrize("rows", [0, 1])
def test_a_span_without_rows_and_one_with_a_single_row_are_reported(
    tmp_path: Path, ctl: Ctl, rows: int
) -> None:
    site = Site(tmp_path, ctl)
    site.calibrate()
    site.measure(rows)
    with open_store(site.state) as store:
        store.record_gap(slot(10), slot(14), GapCause.POWER_LOSS, "<the plug>", period_s=60)
    pdf = tmp_path / "a.pdf"
    ran = site.ctl("report", "--output", pdf)
    assert ran.code == 0, ran.err
    text, _ = text_of(pdf)
    assert "power_loss" in text
    assert "<the plug>" in text
    said = "the row names no calibration" if rows else "the span has no good row"
    assert f"No budget: {said}" in text


def test_the_alarms_of_the_span_are_told(site: Site, tmp_path: Path) -> None:
    for minutes, kind in ((-60, "raised"), (3, "raised"), (4, "sent"), (5, "acknowledged")):
        when = START + timedelta(minutes=minutes)
        by = "Ann" if kind == "acknowledged" else ""
        text = "<b>8 mm</b> since 2026-03-01T00:02:00Z"
        assert note_history(
            site.state, Happened(when, kind, "deck-level", Level.CRITICAL, text, by)
        )
    page = tmp_path / "a.html"
    assert site.ctl("report", "--tz", "Europe/Berlin", "--output", page).code == 0
    cells = Cells(page.read_text(encoding="utf-8"))
    assert cells.row("deck-level") == ["deck-level", "1"]
    said = [row for row in cells.rows if row[1:2] == ["deck-level"]]
    text = "<b>8 mm</b> since 2026-03-01T01:02:00+01:00"
    assert said == [
        ["2026-03-01T01:03:00+01:00", "deck-level", "raised", "critical", text, ""],
        ["2026-03-01T01:05:00+01:00", "deck-level", "acknowledged", "critical", text, "Ann"],
    ]


def test_months_are_given_with_and_without_what_the_ledger_excludes(
    site: Site, tmp_path: Path
) -> None:
    entry = LedgerEntry(
        LedgerKind.EXCLUDE, "Ann", START, "<i>crane</i>", START, START + timedelta(minutes=4)
    )
    site.write(lambda store: store.add_ledger_entry(entry) and None)
    page = tmp_path / "a.html"
    assert site.ctl("report", "--output", page).code == 0
    cells = Cells(page.read_text(encoding="utf-8"))
    assert [row[1] for row in cells.rows if row[:1] == ["2026-03"]] == ["10", "6"]
    said = next(row for row in cells.rows if "Ann" in row)
    assert said[2:] == ["exclude", "all", "Ann", "<i>crane</i>"]


def test_a_report_needs_a_name_that_says_what_it_is(site: Site, tmp_path: Path) -> None:
    assert "ends in .html or .pdf" in site.ctl("report", "--output", tmp_path / "a.doc").err
    ran = site.ctl("report")
    assert (ran.code, ran.out) == (2, "")
    assert "give --output FILE" in ran.err
    assert site.ctl("report", "--monthly", "--output", tmp_path / "a.pdf").code == 2


def test_a_month_is_written_once_and_old_ones_go(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.measure(30, DARK)
    site.config.write_text(
        SIMULATED.replace("[simulation]", "[report]\nmonths_kept = 2\n\n[simulation]")
    )
    directory = site.state / "reports"
    directory.mkdir()
    # Of the month itself one is there: a power cut came between the two, and both are written.
    of_before = ("2025-11.html", "2025-11.pdf", "2026-02.pdf", "2026-01.html", "2026-03.pdf")
    for name in (*of_before, "notes.txt"):
        (directory / name).write_text("of before")
    monkeypatch.setattr("daemon.reports.monthly.datetime", April)
    ran = site.ctl("report", "--monthly")
    assert ran.code == 0, ran.err
    page, pdf = directory / "2026-03.html", directory / "2026-03.pdf"
    assert text_of(pdf)[1] >= 2
    assert "2026-03-01T00:00:00Z" in page.read_text(encoding="utf-8")
    kept = {path.name for path in directory.iterdir()}
    assert kept == {"2026-03.html", "2026-03.pdf", "2026-02.pdf", "notes.txt"}
    before = page.stat().st_mtime_ns, pdf.stat().st_mtime_ns
    again = site.ctl("report", "--monthly")
    assert again.code == 0
    assert "2026-03 is written" in again.err
    assert (page.stat().st_mtime_ns, pdf.stat().st_mtime_ns) == before


def test_a_month_is_written_though_its_reference_cannot_be_read(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.config.write_text(
        SIMULATED.replace("[simulation]", "[report]\nreference = 'survey.csv'\n\n[simulation]")
    )
    monkeypatch.setattr("daemon.reports.monthly.datetime", April)
    ran = site.ctl("report", "--monthly")
    assert ran.code == 0, ran.err
    assert "survey.csv: No such file" in ran.err
    page = site.state / "reports" / "2026-03.html"
    assert "Comparison with a reference" not in page.read_text(encoding="utf-8")
    survey = "time,y_mm,sigma_mm\n2026-02-01T00:00:00Z,1,1\n"
    (site.config.parent / "survey.csv").write_text(survey)
    assert site.ctl("report", "--output", page).code == 0
    assert "No time of the reference lies in this span." in page.read_text(encoding="utf-8")


class April(datetime):
    """A clock that stands in April."""

    @classmethod
    def now(cls, tz=None):
        return datetime(2026, 4, 3, 12, tzinfo=UTC).astimezone(tz)


def test_a_month_without_slots_and_a_site_without_a_record_have_no_report(
    site: Site, tmp_path: Path
) -> None:
    ran = site.ctl("report", "--monthly")
    assert ran.code == 0
    assert "has no slots, so there is no report" in ran.err
    assert not (site.state / "reports").exists()
    ran = site.ctl("--state", tmp_path / "none", "report", "--monthly")
    assert ran.code == 0
    assert "nothing is recorded yet" in ran.err


def test_months_are_those_of_the_zone() -> None:
    """Spring: the month begins an hour before UTC's and ends two hours before."""
    since, until = last_month(datetime(2026, 4, 15, tzinfo=UTC), find_zone("Europe/Berlin"))
    assert since == datetime(2026, 2, 28, 23, tzinfo=UTC)
    assert until == datetime(2026, 3, 31, 22, tzinfo=UTC)
    january = last_month(datetime(2026, 1, 15, tzinfo=UTC), UTC)
    assert january == (datetime(2025, 12, 1, tzinfo=UTC), START - timedelta(days=59))


def test_what_report_says_of_people_is_in_the_config(tmp_path: Path) -> None:
    (tmp_path / "dcam.toml").write_text(
        SIMULATED.replace("[simulation]", f"{REPORT}reference = 'levels.csv'\n\n[simulation]")
    )
    section = load_config(tmp_path / "dcam.toml").report
    assert section.client == "Roads <b>Authority</b>"
    assert section.reference == tmp_path / "levels.csv"


def test_check_knows_the_reports_and_their_reference(site: Site) -> None:
    def findings(section: str) -> dict[str, tuple[str, str]]:
        site.config.write_text(SIMULATED.replace("[simulation]", f"{section}\n[simulation]"))
        found = json.loads(site.ctl("check", "--json").out)["findings"]
        return {one["name"]: (one["state"], one["text"]) for one in found}

    (site.state / "reports").mkdir()
    (site.state / "reports" / "2026-02.pdf").touch()
    state, text = findings("")["report"]
    assert (state, text.endswith("reports, the last 2026-02")) == ("ok", True)
    assert "monthly = false" in findings("[report]\nmonthly = false")["report"][1]
    state, text = findings("[report]\nreference = 'none.csv'")["reference"]
    assert (state, "none.csv: No such file" in text) == ("error", True)
    (site.config.parent / "none.csv").write_text("time,y_mm,sigma_mm\n2026-03-01T00:00Z,1,1\n")
    state, text = findings("[report]\nreference = 'none.csv'")["reference"]
    assert (state, text.endswith("1 values of main")) == ("ok", True)
