"""Rows in bulk: the checksums are those of single rows, whatever the rows hold."""

from __future__ import annotations

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from daemon.store.integrity.checksum import row_digest
from daemon.store.integrity.checksum_columns import damaged_rows, row_digests

INTEGERS = st.integers(-(2**63), 2**63 - 1)
TEXTS = st.text(st.characters(exclude_categories=()), max_size=5)
KINDS = [
    st.floats(allow_nan=False),
    INTEGERS,
    TEXTS,
    st.one_of(st.none(), st.floats(allow_nan=False)),
    st.one_of(st.none(), TEXTS),
    st.one_of(st.none(), INTEGERS, st.floats(allow_nan=False), TEXTS, st.binary(max_size=3)),
    st.none(),
]
"""What a column may hold: one kind, one kind with gaps, anything that damage makes."""


@st.composite
def tables(draw: st.DrawFn) -> dict[str, list[Any]]:
    size = draw(st.integers(1, 5))
    names = draw(st.lists(st.sampled_from("abcdefgh"), unique=True, min_size=1))
    one_row = st.sampled_from(KINDS).flatmap(lambda k: st.lists(k, min_size=size, max_size=size))
    return {name: draw(one_row) for name in names} | {"z": [1] * size}


def rows_of(columns: dict[str, list[Any]]) -> list[dict[str, Any]]:
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


@given(tables())
def test_digests_of_columns_are_those_of_the_rows(columns: dict[str, list[Any]]) -> None:
    assert row_digests("table", columns) == [row_digest("table", row) for row in rows_of(columns)]


@given(tables(), st.data())
def test_the_damaged_rows_are_found_and_no_others(
    columns: dict[str, list[Any]], data: st.DataObject
) -> None:
    digests = [row_digest("table", row) for row in rows_of(columns)]
    wrong = data.draw(st.sets(st.sampled_from(range(len(digests)))))
    stored = [digest ^ 1 if place in wrong else digest for place, digest in enumerate(digests)]
    assert list(damaged_rows("table", columns | {"digest": stored})) == sorted(wrong)
