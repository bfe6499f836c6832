"""The sections of a report, but for its statement of uncertainty."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, tzinfo
from functools import cached_property
from pathlib import Path

from daemon.alarm.history import alarm_history
from daemon.config.model import Config
from daemon.reports.beside_reference import Beside, sentences
from daemon.reports.document import Block, Bullets, Heading, Picture, Text, Verdict, table
from daemon.reports.figure import draw
from daemon.reports.history import History, Month, gap_spans
from daemon.status.coverage import coverage_text
from daemon.status.item import Item, worst
from daemon.store.ledger.entries import LedgerEntry, in_force
from daemon.store.queries.datum_fields import offset_text
from daemon.store.records import CalibrationRecord, DatumRecord, EventRecord
from daemon.text import count_of, span_text
from daemon.version import VERSION
from daemon.zones import in_zone, zone_name, zone_text
from drivers.libraries import has_library

MOST_LINES = 200
"""Of gaps and events; the report says how many more there are, and which command lists them."""


@dataclass(frozen=True)
class Words:
    """How times are written."""

    zone: tzinfo

    def when(self, moment: datetime) -> str:
        """A time in the zone."""
        return zone_text(moment, self.zone)

    def shown(self, text: str) -> str:
        """A text with its times in the zone."""
        return in_zone(text, self.zone)

    @cached_property
    def zone_name(self) -> str:
        """What the zone is called."""
        return zone_name(self.zone)


def head(config: Config, history: History, words: Words, now_utc: datetime) -> Iterator[Block]:
    """For whom, of what, when."""
    yield Text(
        f"Slots from {words.when(history.since_utc)} until {words.when(history.until_utc)}, times: "
        f"{words.zone_name}. Written {words.when(now_utc)} by dcam {VERSION}."
    )
    people = (("Client", config.report.client), ("Contact", config.report.contact))
    named = [f"{what}: {who}" for what, who in people if who]
    if named:
        yield Text("; ".join(named) + ".")
    yield Text(f"{coverage_text(history.coverage)}.", is_strong=True)


def figure(
    config: Config, history: History, words: Words, beside: Beside | None, formats: Sequence[str]
) -> Iterator[Block]:
    """The figure of `plot`, as vectors."""
    if not has_library("matplotlib"):
        yield Text("No figure: matplotlib is not installed.")
        return
    made = {"svg": b"", "pdf": b""}
    for file_format in formats:
        file = io.BytesIO()
        draw(
            history.series,
            gap_spans(history.gaps),
            f"{config.name}: displacement",
            file,
            file_format=file_format,
            reference=beside.marks if beside else (),
            zone=words.zone,
            excluded=history.excluded,
        )
        made[file_format] = file.getvalue()
    yield Picture(made["svg"], made["pdf"], "displacement, rig motion and gaps")


def site_and_method(config: Config) -> Iterator[Block]:
    """What stands there, and how it measures."""
    site = config.site()
    main, sub, board = site.main_target, site.sub_target, site.sub
    yield Heading("Site and method")
    rows = [
        ("main target", f"{len(main.centres_mm)} discs, {main.distance_mm / 1000.0:g} m away"),
        (
            "main camera",
            (
                f"{site.main.focal_length_mm:g} mm lens, {site.main.width_px} x "
                f"{site.main.height_px} px, "
                f"{site.nominal_px_per_mm:.3g} px/mm"
            ),
        ),
        (
            "board on the pier",
            (
                f"{sub.squares_x} x {sub.squares_y} squares of {sub.square_mm:g} mm, "
                f"{sub.distance_mm:g} mm away"
            ),
        ),
        (
            "sub-camera",
            f"{board.focal_length_mm:g} mm lens, {board.width_px} x {board.height_px} px",
        ),
        (
            "schedule",
            (
                f"a value every {span_text(config.schedule.period_s)}, "
                f"{count_of(config.schedule.burst, 'pair')} of images each"
            ),
        ),
    ]
    rows += [
        (
            f"further target {extra.name}",
            f"{extra.role.value}, {extra.target.distance_mm / 1000.0:g} m away",
        )
        for extra in site.extra_targets
    ]
    yield table(("what", "as the config has it"), rows)
    yield Text(
        "A main camera with a long lens watches a target on the bridge. A second camera, bolted "
        "back to "
        "back to it, watches a checkerboard on the pier and so measures how the pair itself has "
        "moved "
        "and turned. The false displacement that this motion causes is predicted by the "
        "calibrated geometry "
        "and taken off. What remains is the displacement of the target relative to the board on "
        "the pier: "
        "x to the right, y up, as the main camera sees it. Each value has a standard uncertainty "
        "(sigma), and a flag: good, suspect (given, with a reason), or bad (withheld). Nothing is "
        "filled in or averaged over."
    )


def completeness(history: History, words: Words) -> Iterator[Block]:
    """Which slots have a value, and why others have none."""
    coverage = history.coverage
    yield Heading("Completeness")
    yield Text(f"{coverage_text(coverage)}.")
    if history.reasons:
        yield Heading("Why other rows are suspect or without value", 3)
        yield table(("reason", "rows"), history.reasons, (1,))
    yield Heading("Gaps", 3)
    if not history.gaps:
        yield Text("None.")
        return
    yield table(
        ("cause", "slots", "share"),
        [
            (cause.value, slots, f"{slots / max(coverage.expected, 1):.2%}")
            for cause, slots in sorted(coverage.gaps.items(), key=lambda one: -one[1])
        ],
        (1, 2),
    )
    more = len(history.gaps) - MOST_LINES
    if more > 0:
        yield Text(f"{more} more before these; dcam-ctl gaps lists them.")
    yield table(
        ("first slot", "last slot", "slots", "cause", "detail"),
        [
            (
                words.when(gap.first_slot_utc),
                words.when(gap.last_slot_utc),
                gap.slots,
                gap.cause.value,
                words.shown(gap.detail),
            )
            for gap in history.gaps[-MOST_LINES:]
        ],
        (2,),
    )


_OF_MONTH = ("mean x, y", "lowest x, y", "highest x, y", "median sigma x, y")


def _month_cells(month: Month) -> tuple[str, ...]:
    signed = (month.mean_mm, month.lowest_mm, month.highest_mm)
    x, y = month.median_sigma_mm
    return (*(f"{one:+.3f}, {two:+.3f}" for one, two in signed), f"{x:.3f}, {y:.3f}")


def values(history: History) -> Iterator[Block]:
    """What was measured, month by month."""
    yield Heading("Good rows by month, mm")
    if history.months:
        rows = [(month.name, month.rows, *_month_cells(month)) for month in history.months]
        yield table(("month", "rows", *_OF_MONTH), rows, range(1, 6))
    else:
        yield Text("None.")
    if history.targets:
        yield Heading("Further targets: their good rows, mm")
        yield table(
            ("target", "role", "rows", "good", *_OF_MONTH),
            [
                (
                    one.name,
                    one.role,
                    one.rows,
                    one.good.rows if one.good else 0,
                    *(_month_cells(one.good) if one.good else ("", "", "", "")),
                )
                for one in history.targets
            ],
            range(2, 8),
        )
    if history.closures:
        yield Heading("What fixed targets show of the rig's error by month, mm")
        yield table(
            ("month", "rows", "closure x, y, rms", "its sigma x, y, rms"),
            [
                (
                    one.name,
                    one.rows,
                    "{:.3f}, {:.3f}".format(*one.rms_mm),
                    "{:.3f}, {:.3f}".format(*one.sigma_mm),
                )
                for one in history.closures
            ],
            (1, 2, 3),
        )
    if history.readings:
        yield Heading("Temperatures and other readings")
        yield table(
            ("reading", "unit", "rows", "mean", "lowest", "highest"),
            [
                (
                    one.name,
                    one.unit,
                    one.rows,
                    *(f"{value:.4g}" for value in (one.mean, one.lowest, one.highest)),
                )
                for one in history.readings
            ],
            range(2, 6),
        )


def reference(beside: Beside | None) -> Iterator[Block]:
    """How the record compares with what others measured."""
    if beside is None:
        return
    yield Heading("Comparison with a reference")
    yield Text(
        f"Reference: {beside.reference.name}. Differences are rows less reference; E_n is a "
        "difference over its expanded uncertainty (k = 2; ISO 13528, EA-4/02): up to 1 the two "
        "agree."
    )
    if not any(one.times for one in beside.comparisons):
        yield Text("No time of the reference lies in this span.")
    for one in beside.comparisons:
        if one.times:
            yield Bullets(tuple(sentences(one)))


def ledger(entries: Sequence[LedgerEntry], history: History, words: Words) -> Iterator[Block]:
    """What people say of spans, and the months without what they exclude."""
    found = [
        one
        for one in in_force(entries)
        if one.since_utc is not None
        and one.until_utc is not None
        and one.since_utc < history.until_utc
        and one.until_utc > history.since_utc
    ]
    if not found:
        return
    yield Heading("Quality ledger")
    yield table(
        ("from", "until", "what", "point", "author", "text"),
        [
            (
                words.when(one.since_utc) if one.since_utc else "",
                words.when(one.until_utc) if one.until_utc else "",
                *(one.kind.value, one.point or "all", one.author, words.shown(one.text)),
            )
            for one in found
        ],
    )
    if history.months_without:
        yield Text(
            "The analysis and the comparison with a reference are without the excluded spans, all "
            "other figures of this report are with them. Good rows of the main target by month "
            "without them, mm:"
        )
        rows = [(one.name, one.rows, *_month_cells(one)) for one in history.months_without]
        yield table(("month", "rows", *_OF_MONTH), rows, range(1, 6))


_OF_ALARMS = ("raised", "changed", "cleared", "contradicted", "acknowledged", "silenced")
"""What a reader of a report wants to know of them; messages that were sent stand in their list."""


def alarms(state: Path, history: History, words: Words) -> Iterator[Block]:
    """Which alarms there were."""
    yield Heading("Alarms")
    found = [
        one
        for one in alarm_history(state, history.since_utc, history.until_utc)
        if one.kind in _OF_ALARMS
    ]
    raised = Counter(one.name for one in found if one.kind == "raised")
    if not raised:
        yield Text("None was raised in this span.")
    else:
        yield table(("alarm", "times raised"), raised.most_common(), (1,))
    if len(found) > MOST_LINES:
        yield Text(
            f"{len(found) - MOST_LINES} more entries before these; dcam-ctl alarm lists them."
        )
    if found:
        yield table(
            ("when", "alarm", "what", "level", "text", "by"),
            [
                (
                    *(words.when(one.time_utc.replace(microsecond=0)), one.name, one.kind),
                    *(one.level.name.lower(), words.shown(one.text), one.by),
                )
                for one in found[-MOST_LINES:]
            ],
        )


def calibrations(
    found: Sequence[tuple[CalibrationRecord | None, DatumRecord | None]],
    config_hash: str,
    words: Words,
) -> Iterator[Block]:
    """What the rows were measured with, and the chain of zeros."""
    yield Heading("Calibrations and datum")
    if not found:
        yield Text("No row of this span was measured with one.")
    chain = [
        (
            datum.calibration_id,
            words.when(datum.reference_utc) if datum.reference_utc else "",
            datum.method.value,
            offset_text(datum.offset),
            words.shown(datum.detail),
        )
        for _, datum in found
        if datum is not None
    ]
    if chain:
        yield table(
            ("calibration", "reference", "found by", "in the record's zero", "detail"), chain
        )
    for record, _ in found:
        if record is None:
            continue
        passed = "passed" if record.report.passed else "not passed"
        yield Heading(
            f"Calibration {record.id}, of {words.when(record.created_utc.replace(microsecond=0))}, "
            f"{record.content.get('method', '')}, {passed}",
            3,
        )
        yield Bullets(tuple(words.shown(line) for line in record.report.lines))
        if record.config_hash != config_hash:
            yield Text("The config has changed since.")


def events(found: Sequence[EventRecord], words: Words) -> Iterator[Block]:
    """What happened to the system."""
    if not found:
        return
    yield Heading("Events")
    more = len(found) - MOST_LINES
    if more > 0:
        yield Text(f"{more} more before these.")
    yield table(
        ("when", "what", "detail"),
        [
            (words.when(one.time_utc), one.kind, words.shown(one.detail))
            for one in found[-MOST_LINES:]
        ],
    )


def state(items: list[Item], words: Words) -> Iterator[Block]:
    """How the site is now."""
    yield Heading("The site when this was written")
    level = worst(items).name
    yield Verdict(level, level)
    yield table(
        ("what", "state", "text"),
        [(item.name, item.level.name.lower(), words.shown(item.text)) for item in items],
    )
