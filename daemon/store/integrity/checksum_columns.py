"""The checksums of many rows at once: the same text as `checksum` makes, column by column.

Several times as fast as row by row. A row whose text made here does not fit its digest is looked
at again by `row_digest`, which decides: a mistake here costs time and hides nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from hashlib import blake2b
from typing import Any

import numpy as np

from daemon.store.integrity.checksum import DIGEST, encoded, row_digest

Columns = Mapping[str, Sequence[Any]]
"""Values of at least one row as SQLite holds them, by column; all columns are equally long."""

_BREAK = "\0"
"""Between two rows' texts: JSON has no such byte."""


def row_digests(table: str, columns: Columns) -> list[int]:
    """The digest of each row, as `row_digest` gives it."""
    rows = map("".join, zip(*_fragments(columns), strict=True))
    texts = (f"{table}{{{row[:-1]}}}" for row in rows)
    digests = (blake2b(text.encode(), digest_size=8).digest() for text in texts)
    found: list[int] = np.frombuffer(b"".join(digests), dtype=">i8").tolist()
    return found


def damaged_rows(table: str, columns: Columns) -> Iterator[int]:
    """The places of the rows that are not what was written, in order."""
    pairs = zip(row_digests(table, columns), columns[DIGEST], strict=True)
    for place, (made, stored) in enumerate(pairs):
        if made != stored:
            row = {name: values[place] for name, values in columns.items()}
            if row_digest(table, row) != stored:
                yield place


def _fragments(columns: Columns) -> Iterator[Sequence[str]]:
    """Of each column, in the order of their names, each row's part of what its digest is of."""
    for name in sorted(columns):
        if name == DIGEST:
            continue
        key, values = f'"{name}":', columns[name]
        kinds = set(map(type, values))
        if type(None) not in kinds:
            yield _parts(key, values, kinds)
        elif len(kinds) > 1:
            each = iter(_parts(key, [v for v in values if v is not None], kinds - {type(None)}))
            yield ["" if value is None else next(each) for value in values]


def _parts(key: str, values: Sequence[Any], kinds: set[type]) -> Sequence[str]:
    """Each value behind its key, with a comma: `"x_mm":0.5,`."""
    if kinds == {int} or (kinds == {float} and np.isfinite(values).all()):
        return _behind(key, map(repr, values), ",")  # as Python's json writes numbers
    if kinds == {str}:
        text = "".join(values)
        if len(encoded(text)) == len(text) + 2:  # nothing in it is written in another way
            return _behind(f'{key}"', values, '",')
    return _behind(key, map(encoded, values), ",")


def _behind(key: str, texts: Iterable[str], end: str) -> Sequence[str]:
    """Put each text between two others: in one go it takes half the time."""
    return f"{key}{f'{end}{_BREAK}{key}'.join(texts)}{end}".split(_BREAK)
