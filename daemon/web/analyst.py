"""The page's worker for long work: what a span of the record says, and a reference beside it.

A process of its own, as scipy takes more memory than the page may and a year takes seconds:
`python -m daemon.web.analyst CONFIG STATE`.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

from daemon.analysis.fields import moment, study_fields
from daemon.analysis.reading import analyse_store
from daemon.analysis.sentences import sentences
from daemon.analysis.study import Asked
from daemon.config.reading import Config, load_config
from daemon.plain import plain
from daemon.reports import beside_reference
from daemon.reports.beside_reference import PointComparison, read_beside
from daemon.reports.figure import ReferenceMarks
from daemon.store.database import open_store_readonly
from daemon.web.lines import answer_lines
from daemon.zones import find_zone


def answer(config: Config, state: Path, asked: Mapping[str, Any]) -> dict[str, Any]:
    """Do what is asked. Raises DcamError."""
    since, until = (datetime.fromisoformat(asked[name]) for name in ("since", "until"))
    if asked["what"] == "comparison":
        found = _comparison(config, state, since, until)
    else:
        found = _analysis(config, state, asked, since, until)
    return {name: plain(value) for name, value in found.items()}


def _analysis(
    config: Config, state: Path, asked: Mapping[str, Any], since: datetime, until: datetime
) -> dict[str, Any]:
    zone = find_zone(config.site_section.timezone or "UTC")
    loaded = datetime.fromisoformat(asked["loaded"]) if asked["loaded"] else None
    wanted = Asked(asked["point"], asked["axis"], zone=zone, loaded=loaded)
    with open_store_readonly(state) as store:
        study = analyse_store(store, since, until, wanted, config.schedule.period_s)
    return {
        **study_fields(study),
        "confidence": wanted.confidence,
        "sentences": list(sentences(study, wanted.confidence)),
    }


def _comparison(config: Config, state: Path, since: datetime, until: datetime) -> dict[str, Any]:
    file = config.report.reference
    if file is None:
        return {"reference": None, "comparisons": [], "marks": []}
    how = beside_reference.Settings()
    with open_store_readonly(state) as store:
        found = read_beside(store.path, file, how.zero, how.window_s, since, until)
    return {
        "reference": found.reference.name,
        "comparisons": [_fields(one) for one in found.comparisons],
        "marks": [_mark_fields(one) for one in found.marks],
    }


def _mark_fields(one: ReferenceMarks) -> dict[str, Any]:
    """What the figures draw."""
    return {
        "quantity": f"{one.axis}_mm.{one.point}",
        "times_s": (one.times.astype("datetime64[us]").astype("int64") * 1e-6).tolist(),
        "mm": one.values_mm.tolist(),
        "expanded_mm": one.expanded_mm.tolist(),
    }


def _fields(one: PointComparison) -> dict[str, Any]:
    differences = () if one.found is None else one.found.differences
    return {
        "point": one.point,
        "axis": one.axis,
        "agrees": None if one.found is None else one.found.agrees,
        "sentences": beside_reference.sentences(one),
        "differences": [{**asdict(each), "time": moment(each.time_s)} for each in differences],
    }


def main() -> None:
    """Answer until nobody asks any more."""
    config, state = load_config(Path(sys.argv[1])), Path(sys.argv[2])
    answer_lines(lambda asked: answer(config, state, asked))


if __name__ == "__main__":
    main()
