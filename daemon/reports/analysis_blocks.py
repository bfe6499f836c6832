"""What `analyse` says of a span, as a section of its report."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime

from daemon.analysis.record import RecordReader
from daemon.analysis.sentences import sentences
from daemon.analysis.study import Asked, Study, study
from daemon.errors import WorkFailedError
from daemon.reports.document import Block, Bullets, Heading, Text, table
from daemon.reports.sections import Words
from daemon.store.queries.columns import Tell

MOST_DAYS = 62
"""Days in a report's table; of a longer span the months stand in theirs."""


@dataclass(frozen=True, slots=True)
class Studies:
    """Both axes of the main target; none of a span without any row."""

    y: Study
    x: Study


def make_studies(
    reader: RecordReader,
    span: tuple[datetime, datetime],
    period_s: int,
    words: Words,
    tell: Tell = lambda _done, _total: None,
) -> Studies | None:
    """Analyse both axes of the rows that the reader has taken; None without any row."""
    try:
        record = reader.record()
    except WorkFailedError:
        return None
    studies = {}
    for done, axis in enumerate("yx"):
        tell(done, 2)
        studies[axis] = study(record, Asked(axis=axis, zone=words.zone), span, period_s)
    return Studies(**studies)


def analysis_blocks(studies: Studies | None, words: Words) -> Iterator[Block]:
    """Days, temperature, trend and steps of the main target."""
    if studies is None:
        return
    yield Heading("Analysis of the main target")
    days = list(zip(studies.y.days, studies.x.days, strict=True))
    if len(days) <= MOST_DAYS:
        yield table(
            (
                "day",
                "complete",
                "y lowest, mm",
                "mean",
                "highest",
                "x lowest, mm",
                "mean",
                "highest",
            ),
            [
                (
                    y.day.isoformat(),
                    f"{y.completeness:.0%}",
                    *(_mm(mm) for mm in (y.lowest_mm, y.mean_mm, y.highest_mm)),
                    *(_mm(mm) for mm in (x.lowest_mm, x.mean_mm, x.highest_mm)),
                )
                for y, x in days
            ],
            range(1, 8),
        )
    for axis, one in (("y", studies.y), ("x", studies.x)):
        confidence = Asked().confidence
        said = tuple(f"{axis}: {words.shown(line)}" for line in sentences(one, confidence))
        if said:
            yield Bullets(said)
    yield Text(
        "Good rows only; fitted to hourly means with noise that remembers; in brackets the "
        "interval of confidence. docs/analysis.md explains each number."
    )


def _mm(value: float) -> str:
    return "" if math.isnan(value) else f"{value:+.3f}"
