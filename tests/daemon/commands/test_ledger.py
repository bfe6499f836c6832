"""`dcam-ctl ledger` from outside: who said what of which span, and what became of it."""

from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from core.results import Displacement, Flag, TargetMeasurement
from core.site import TargetRole
from daemon.store.database import open_store
from daemon.store.ledger.entries import LedgerEntry, LedgerKind
from daemon.store.records import MeasurementRecord
from daemon.times import slot_text
from tests.daemon.commands.conftest import GOOD, Ctl, Ran
from tests.daemon.store.examples import full_record, slot

SPAN = ("--since", "2026-05-15T08:00Z", "--until", "2026-05-15T17:00Z")


@pytest.fixture
def state(tmp_path: Path) -> Path:
    with open_store(tmp_path / "state"):
        return tmp_path / "state"


@pytest.fixture
def ledger(ctl: Ctl, state: Path):
    def run(*arguments: object) -> Ran:
        return ctl("--state", state, "ledger", *arguments)

    return run


def test_an_exclusion_is_entered_listed_commented_and_taken_back(ledger) -> None:
    entered = ledger("exclude", *SPAN, "--by", "Eve", "plate being painted")
    assert entered.code == 0, entered.err
    assert entered.out == "entry 1: exclude 2026-05-15T08:00:00Z to 2026-05-15T16:59:59Z\n"
    assert ledger("comment", "1", "see the diary").code == 0
    listed = ledger().out
    assert "plate being painted (commented)" in listed
    assert "Eve" in listed
    said = json.loads(ledger("--json").out)
    (span,) = said["excluded"]["main"]
    assert span == {"since_utc": "2026-05-15T08:00:00Z", "until_utc": "2026-05-15T17:00:00Z"}

    assert ledger("undo", "1", "it was another plate").code == 0
    assert "nothing holds" in ledger().out
    history = json.loads(ledger("history", "--json").out)
    assert [entry["kind"] for entry in history["entries"]] == ["exclude", "comment", "undo"]
    assert history["entries"][0]["undone_by"] == 3
    assert history["excluded"]["main"] == []


def test_times_are_given_and_shown_in_the_zone_of_people(ledger) -> None:
    zone = ("--tz", "Europe/Berlin")
    summer = ("--since", "2026-05-15T10:00", "--until", "2026-05-15T19:00")
    assert ledger("annotate", *zone, *summer, "slab cast").code == 0
    (entry,) = json.loads(ledger("--json").out)["entries"]
    assert entry["since_utc"] == "2026-05-15T08:00:00Z"
    assert "2026-05-15T10:00:00+02:00" in ledger(*zone).out


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (("exclude", "why"), "give --since and --until"),
        (("exclude", *SPAN, " "), "say it in words"),
        (("exclude", *SPAN[:3], SPAN[1], "why"), "the span is empty"),
        (("undo", "4", "why"), "the ledger has no entry 4"),
        (("anotate", *SPAN, "why"), "Did you mean 'annotate'"),
    ],
)
def test_a_mistake_is_one_clear_line_and_enters_nothing(ledger, arguments, why) -> None:
    ran = ledger(*arguments)
    assert ran.code == 2
    assert why in ran.err
    assert "Traceback" not in ran.err
    assert ledger().out == "the ledger is empty\n"


def test_a_point_that_the_config_does_not_have_is_refused(ctl: Ctl, bench: Path, state) -> None:
    config = ("--config", bench / "dcam.toml", "--state", state)
    ran = ctl(*config, "ledger", "exclude", *SPAN, "--point", "abutmend", "why")
    assert ran.code == 2
    assert "--point abutmend: the config has main" in ran.err
    assert ctl(*config, "ledger", "exclude", *SPAN, "--point", "main", "why").code == 0


def test_exports_mark_what_is_excluded_and_keep_its_values(ctl: Ctl, state: Path, ledger) -> None:
    with open_store(state) as store:
        for number in range(3):
            store.add_measurement(full_record(slot(number)))
    since, until = (slot_text(slot(number)) for number in (1, 2))
    assert ledger("exclude", "--since", since, "--until", until, "paint").code == 0
    whole = list(csv.DictReader(io.StringIO(ctl("--state", state, "export").out)))
    assert [row["excluded"] for row in whole] == ["", "all", ""]
    assert all(row["x_mm"] for row in whole)
    plain = ctl("--state", state, "export", "--format", "csv-plain").out
    quality = [row["quality"] for row in csv.DictReader(io.StringIO(plain))]
    assert [word == "excluded" for word in quality] == [False, True, False]


@pytest.fixture
def excluded(ctl: Ctl, bench: Path, state: Path, ledger) -> tuple[object, ...]:
    """A record of three good minutes, of which the ledger leaves out the one at 9 mm."""
    with open_store(state) as store:
        for number, mm in enumerate((1.0, 9.0, 1.0)):
            value = Displacement(np.array([0.0, mm]), np.eye(2) * 1e-4)
            row = replace(GOOD, corrected=value, raw=value)
            store.add_measurement(MeasurementRecord(slot(number), row, "hash", "1.0"))
    since, until = (slot_text(slot(number)) for number in (1, 2))
    assert ledger("exclude", "--since", since, "--until", until, "--by", "Eve", "paint").code == 0
    return "--config", bench / "dcam.toml", "--state", state


def test_a_figure_hatches_or_leaves_out_what_is_excluded(ctl: Ctl, excluded, tmp_path) -> None:
    sizes = {}
    for name, flags in (("with", ()), ("without", ("--without-excluded",))):
        figure = tmp_path / f"{name}.svg"
        assert ctl(*excluded, "plot", *flags, "--output", figure).code == 0
        sizes[name] = figure.read_text()
        assert "<!-- excluded -->" in sizes[name]
    assert _highest_label(sizes["with"]) > 5.0
    assert _highest_label(sizes["without"]) < 5.0


def test_a_figure_leaves_out_what_is_excluded_of_one_point_only(
    ctl: Ctl, bench: Path, state: Path, tmp_path: Path
) -> None:
    still = Displacement(np.zeros(2), np.eye(2) * 1e-4)
    with open_store(state) as store:
        for number, mm in enumerate((1.0, 9.0, 1.0)):
            value = Displacement(np.array([0.0, mm]), np.eye(2) * 1e-4)
            further = TargetMeasurement("span-2", TargetRole.MEASURED, Flag.GOOD, (), value, value)
            row = replace(GOOD, corrected=still, raw=still, targets=(further,))
            store.add_measurement(MeasurementRecord(slot(number), row, "hash", "1.0"))
    where = "--config", bench / "dcam.toml", "--state", state
    figure = tmp_path / "without.svg"
    for point, shown in (("main", True), ("span-2", False)):
        entry = LedgerEntry(LedgerKind.EXCLUDE, "Eve", slot(3), "paint", slot(1), slot(2), point)
        with open_store(state) as store:
            store.add_ledger_entry(entry)
        assert ctl(*where, "plot", "--without-excluded", "--output", figure).code == 0
        assert (_highest_label(figure.read_text()) > 5.0) is shown


def _highest_label(svg: str) -> float:
    """The largest number on the axis of the first panel, whose name follows its numbers."""
    axis = svg[: svg.index("vertical y (mm)")]
    return max(float(text) for text in re.findall(r"<!-- (\d+(?:\.\d+)?) -->", axis))
