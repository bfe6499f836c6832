"""docs/columns.md says of every column what the schema and the exports say of it."""

from __future__ import annotations

import re
from pathlib import Path

from daemon.reports.slot_table import COLUMNS, kind_of_column
from daemon.reports.table import DECIMALS
from daemon.store.queries import column_meanings
from daemon.store.rows.targets import TARGET_COLUMNS
from daemon.store.schema import MeasurementRow

PAGE = (Path(__file__).parents[3] / "docs" / "columns.md").read_text(encoding="utf-8")
KINDS = {
    "time": "time",
    "real": "number",
    "whole": "whole number",
    "truth": "true, false",
    "text": "text",
}
ENDINGS = {"db": "dB", "c": "degC"}
"""Units that are written in another way at the end of a name."""


def test_the_page_lists_every_column_of_an_export_in_its_order() -> None:
    lines = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \| (.*?) \|$", PAGE, flags=re.MULTILINE)
    assert lines == [(name, *_unit_kind_text(name)) for name in COLUMNS], (
        "docs/columns.md and daemon/store/queries/column_meanings.py differ"
    )


def _unit_kind_text(name: str) -> tuple[str, str, str]:
    unit, text = column_meanings.of(name)
    return unit, KINDS[kind_of_column(name)], text


def test_every_column_of_the_schema_has_a_meaning_and_no_other() -> None:
    table = [column.name for column in MeasurementRow.__table__.columns]
    assert list(column_meanings.MEANINGS) == table
    assert set(COLUMNS) == {*table, "excluded", "detail"} - {"id", "digest", "targets", "readings"}


def test_the_page_lists_every_column_of_a_further_target_in_its_order() -> None:
    lines = re.findall(r"^\| `<name>_(\w+)` \| (.*?) \| (.*?) \| .*? \|$", PAGE, flags=re.MULTILINE)
    expected = [(key, *_unit_kind_text(f"a-1_{key}")[:2]) for key in TARGET_COLUMNS]
    assert lines == expected


def test_a_number_has_the_unit_that_its_name_ends_in() -> None:
    for name in COLUMNS:
        unit, ending = column_meanings.of(name).unit, name.rpartition("_")[2]
        if kind_of_column(name) == "real":
            assert unit == ENDINGS.get(ending, ending), name
        else:
            assert not unit, name


def test_the_page_says_how_many_digits_there_are() -> None:
    for ending, decimals in DECIMALS.items():
        unit = ENDINGS.get(ending, ending)
        sentence = next(part for part in PAGE.split("anything that")[1].split(",") if unit in part)
        assert str(decimals) in sentence, ending
