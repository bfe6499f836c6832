"""The page of `dcam-ctl report`."""

from __future__ import annotations

import base64
import importlib.util
import io
from array import array
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from jinja2 import Environment, StrictUndefined

from core.arrays import FloatArray
from core.results import Flag
from daemon.config.reading import Installation
from daemon.reports.figure import draw
from daemon.reports.history import History, gap_spans
from daemon.status.coverage import coverage_text
from daemon.status.facts import collect_facts
from daemon.status.verdict import judge, worst
from daemon.store.database import Store
from daemon.store.records import MeasurementRecord
from daemon.text import span_text, utc_text
from daemon.version import VERSION

_TEMPLATE = Path(__file__).with_name("page.html.j2")
MOST_LINES = 200
"""Of gaps and events; the page says how many more there are, and which command lists them."""


@dataclass(frozen=True, slots=True)
class Month:
    """The good rows of a month, in mm."""

    name: str
    rows: int
    mean_mm: tuple[float, float]
    lowest_mm: tuple[float, float]
    highest_mm: tuple[float, float]
    median_sigma_mm: tuple[float, float]


def render(site: Installation, store: Store, history: History) -> str:
    """Make the page. Raises StoreError, OSError."""
    rows = store.measurements(history.since_utc, history.until_utc)
    months, reasons, calibrations = _summary(rows)
    facts = collect_facts(site.config, site.state_directory, datetime.now(UTC))
    items = judge(facts)
    events = store.events(history.since_utc, history.until_utc)
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.filters |= {"utc": utc_text, "span": span_text}
    return environment.from_string(_TEMPLATE.read_text(encoding="utf-8")).render(
        site=site.config.name,
        version=VERSION,
        now_utc=facts.now_utc.replace(microsecond=0),
        history=history,
        coverage=coverage_text(history.coverage),
        level=worst(items).name,
        items=[(item.name, item.level.name.lower(), item.text) for item in items],
        figure=_figure(site.config.name, history),
        months=months,
        reasons=reasons,
        gaps=history.gaps[-MOST_LINES:],
        more_gaps=max(len(history.gaps) - MOST_LINES, 0),
        events=events[-MOST_LINES:],
        more_events=max(len(events) - MOST_LINES, 0),
        calibrations=[store.calibration(number) for number in sorted(calibrations)],
        config_hash=site.config.config_hash(),
    )


def _summary(
    rows: Iterable[MeasurementRecord],
) -> tuple[list[Month], list[tuple[str, int]], set[int]]:
    """Good rows by month, reasons of the others by number, and the calibrations measured with."""
    months: dict[str, _Good] = {}
    reasons: Counter[str] = Counter()
    calibrations: set[int] = set()
    for row in rows:
        measurement, displacement = row.measurement, row.measurement.corrected
        reasons.update(reason.value for reason in measurement.reasons)
        if row.calibration_id is not None:
            calibrations.add(row.calibration_id)
        if measurement.flag is Flag.GOOD and displacement is not None:
            good = months.setdefault(f"{row.slot_utc:%Y-%m}", _Good())
            good.mm.extend(displacement.mm)
            good.sigma_mm.extend(np.sqrt(np.diag(displacement.covariance_mm2)))
    found = [good.month(name) for name, good in months.items()]
    return found, reasons.most_common(), calibrations


def _figure(site: str, history: History) -> str | None:
    """The figure as a data URL; None where matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        return None
    file = io.BytesIO()
    thinned = f", every {history.every}th row" if history.every > 1 else ""
    draw(history.series, gap_spans(history.gaps), f"{site}: displacement{thinned}", file)
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode('ascii')}"


class _Good:
    """Figures of the good rows of one month, as they come."""

    def __init__(self) -> None:
        self.mm, self.sigma_mm = array("d"), array("d")

    def month(self, name: str) -> Month:
        """What is told of them."""
        mm, sigma = np.array(self.mm).reshape(-1, 2), np.array(self.sigma_mm).reshape(-1, 2)

        def pair(values: FloatArray) -> tuple[float, float]:
            return float(values[0]), float(values[1])

        return Month(
            name=name,
            rows=len(mm),
            mean_mm=pair(mm.mean(axis=0)),
            lowest_mm=pair(mm.min(axis=0)),
            highest_mm=pair(mm.max(axis=0)),
            median_sigma_mm=pair(np.median(sigma, axis=0)),
        )
