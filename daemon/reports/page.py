"""The report for the client: one document, as an HTML page that needs nothing else and as PDF."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, tzinfo
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from daemon.analysis.record import RecordReader
from daemon.config.reading import Installation
from daemon.reports import sections
from daemon.reports.analysis_blocks import Studies, analysis_blocks, make_studies
from daemon.reports.beside_reference import Beside, read_beside
from daemon.reports.document import Block, Document
from daemon.reports.history import History, read_history
from daemon.reports.statement import TRIALS, Statement, make_statement
from daemon.reports.statement_blocks import statement_blocks
from daemon.status.facts import collect_facts
from daemon.status.verdict import judge
from daemon.store.database import Store
from daemon.store.ledger.entries import read_ledger
from daemon.store.queries.columns import Tell
from daemon.store.recorded_span import recorded_span

_TEMPLATE = Path(__file__).with_name("document.html.j2")


@dataclass(frozen=True, slots=True)
class ReportPlan:
    """What a report is to be of."""

    since: datetime | None
    until: datetime | None
    zone: tzinfo = UTC
    reference: Path | None = None
    zero: str = "free"
    window_s: float = 300.0
    trials: int = TRIALS
    formats: tuple[str, ...] = ("html", "pdf")


@dataclass(frozen=True, slots=True)
class Report:
    """A report, and what it rests on."""

    document: Document
    history: History


def make_report(
    site: Installation,
    store: Store,
    plan: ReportPlan,
    tell: Tell = lambda _done, _total: None,
    begin: Callable[[str], None] = lambda _what: None,
) -> Report:
    """Read the record once and put the report together.

    tell hears how far a piece of work has come, begin which one begins. Raises StoreError, OSError,
    WorkFailedError if there are no slots or the reference cannot be used, HardwareError if it
    cannot be read.
    """
    schedule = site.config.schedule
    span = recorded_span(store, plan.since, plan.until)
    reader = RecordReader(store.path, *span)
    history = read_history(
        store,
        *span,
        period_s=schedule.period_s,
        offset_s=schedule.offset_s,
        tell=tell,
        also=reader.add,
    )
    beside = None
    if plan.reference is not None:
        beside = read_beside(store.path, plan.reference, plan.zero, plan.window_s, *span)
    begin("analysing")
    words = sections.Words(plan.zone)
    studies = make_studies(reader, span, schedule.period_s, words, tell)
    begin("checking the uncertainty")
    statement = _statement(site, store, history, plan, tell)
    begin("drawing")
    read = _Read(history, beside, studies, statement)
    blocks = tuple(_blocks(site, store, plan, read))
    span_text = f"{words.when(history.since_utc)} to {words.when(history.until_utc)}"
    title = f"{site.config.name}: {span_text}"
    return Report(Document(site.config.name, title, blocks), history)


def _statement(
    site: Installation, store: Store, history: History, plan: ReportPlan, tell: Tell
) -> Statement | str:
    if history.good is None:
        return "the span has no good row"
    config = site.config
    slot_utc = history.good.median_slot_utc
    return make_statement(store, config.site(), config.config_hash(), slot_utc, tell, plan.trials)


@dataclass(frozen=True, slots=True)
class _Read:
    """What was found."""

    history: History
    beside: Beside | None
    studies: Studies | None
    statement: Statement | str


def _blocks(site: Installation, store: Store, plan: ReportPlan, read: _Read) -> Iterator[Block]:
    config, words = site.config, sections.Words(plan.zone)
    history, beside = read.history, read.beside
    facts = collect_facts(config, site.state_directory, datetime.now(UTC))
    pictures: Sequence[str] = [{"html": "svg"}.get(one, one) for one in plan.formats]
    yield from sections.head(config, history, words, facts.now_utc.replace(microsecond=0))
    yield from sections.figure(config, history, words, beside, pictures)
    yield from sections.values(history)
    yield from analysis_blocks(read.studies, words)
    yield from sections.site_and_method(config)
    yield from sections.completeness(history, words)
    yield from sections.reference(beside)
    yield from sections.ledger(read_ledger(store.path), history, words)
    yield from sections.alarms(site.state_directory, history, words)
    found = [(store.calibration(number), store.datum(number)) for number in history.calibrations]
    yield from sections.calibrations(found, config.config_hash(), words)
    yield from statement_blocks(
        read.statement,
        history.good,
        words.when,
        config.report.traceability,
        config.site().main_target.distance_mm,
    )
    yield from sections.events(store.events(history.since_utc, history.until_utc), words)
    yield from sections.state(judge(facts), words)


def write_html(document: Document) -> str:
    """Make the page."""
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.filters["base64"] = lambda content: base64.b64encode(content).decode("ascii")
    template = environment.from_string(_TEMPLATE.read_text(encoding="utf-8"))
    return template.render(document=document)
