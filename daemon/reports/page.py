"""The page of `dcam-ctl report`."""

from __future__ import annotations

import base64
import importlib.util
import io
from datetime import UTC, datetime, tzinfo
from functools import partial
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from daemon.config.reading import Installation
from daemon.reports.figure import draw
from daemon.reports.history import History, gap_spans
from daemon.status.coverage import coverage_text
from daemon.status.facts import collect_facts
from daemon.status.item import worst
from daemon.status.verdict import judge
from daemon.store.database import Store
from daemon.store.datum_fields import offset_text
from daemon.text import span_text
from daemon.version import VERSION
from daemon.zones import in_zone, zone_name, zone_text

_TEMPLATE = Path(__file__).with_name("page.html.j2")
MOST_LINES = 200
"""Of gaps and events; the page says how many more there are, and which command lists them."""


def render(site: Installation, store: Store, history: History, zone: tzinfo = UTC) -> str:
    """Make the page, its times in a zone. Raises StoreError, OSError."""
    facts = collect_facts(site.config, site.state_directory, datetime.now(UTC))
    items = judge(facts)
    events = store.events(history.since_utc, history.until_utc)
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.filters |= {
        "when": partial(zone_text, zone=zone),
        "shown": partial(in_zone, zone=zone),
        "span": span_text,
        "offset": offset_text,
    }
    return environment.from_string(_TEMPLATE.read_text(encoding="utf-8")).render(
        site=site.config.name,
        version=VERSION,
        zone=zone_name(zone),
        now_utc=facts.now_utc.replace(microsecond=0),
        history=history,
        coverage=coverage_text(history.coverage),
        level=worst(items).name,
        items=[(item.name, item.level.name.lower(), in_zone(item.text, zone)) for item in items],
        figure=_figure(site.config.name, history, zone),
        months=history.months,
        reasons=history.reasons,
        gaps=history.gaps[-MOST_LINES:],
        more_gaps=max(len(history.gaps) - MOST_LINES, 0),
        events=events[-MOST_LINES:],
        more_events=max(len(events) - MOST_LINES, 0),
        calibrations=[
            (store.calibration(number), store.datum(number)) for number in history.calibrations
        ],
        config_hash=site.config.config_hash(),
    )


def _figure(site: str, history: History, zone: tzinfo) -> str | None:
    """The figure as a data URL; None where matplotlib is not installed."""
    if importlib.util.find_spec("matplotlib") is None:
        return None
    file = io.BytesIO()
    draw(history.series, gap_spans(history.gaps), f"{site}: displacement", file, zone=zone)
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode('ascii')}"
