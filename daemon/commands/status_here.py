"""`dcam-ctl status` of this computer's own site: a verdict, answers, a table, figures."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime

import click

from daemon.alarm.armed import all_items
from daemon.commands.options import Options
from daemon.commands.output import for_terminal, gap_fields, hanging, one_line, print_json, say
from daemon.errors import StoreError
from daemon.status.answers import answers
from daemon.status.facts import Facts, collect_facts
from daemon.status.item import Item, Level, worst
from daemon.status.verdict import no_verdict
from daemon.store.queries.datum_fields import datum_fields
from daemon.store.queries.json_fields import result_fields, target_fields
from daemon.store.queries.overview import TargetSummary
from daemon.store.records import Coverage
from daemon.text import utc_text

_WORD = 11
"""Columns of an answer's word."""
_NAME, _STATE = 17, 10
"""Columns of the table before its text."""
COLOURS = {
    Level.OK: "green",
    Level.WARNING: "yellow",
    Level.CRITICAL: "red",
    Level.UNKNOWN: "magenta",
}


def look_here(options: Options, at_utc: datetime | None, *, as_json: bool) -> Level:
    """Look once, and print. Raises ConfigError, HardwareError, StoreError."""
    facts, items = _judged(options, at_utc)
    if as_json:
        print_json(status_fields(facts, items))
    else:
        print_status(facts, items)
    return worst(items)


def _judged(options: Options, at_utc: datetime | None) -> tuple[Facts, list[Item]]:
    """Look once; the database is closed when this returns."""
    facts = collect_facts(options.config, options.state, at_utc or datetime.now(UTC))
    return facts, all_items(options.config, options.state, facts)


def watch_here(options: Options, period_s: float) -> Level:
    """Look until Ctrl-C; a database that cannot be read now may be readable the next time."""
    level = Level.UNKNOWN
    try:
        while True:
            try:
                facts, items = _judged(options, None)
                level, lines = worst(items), list(status_lines(facts, items))
            except StoreError as error:
                why = no_verdict(error)
                level, lines = why.level, for_terminal(f"DCAM {why.level.name} - {why.text}")
            _redraw(lines)
            time.sleep(period_s)
    except KeyboardInterrupt:
        say()
        return level


def _redraw(lines: list[str]) -> None:
    """Show a look in place of the last one, cut to the screen; on a pipe below the last one."""
    if sys.stdout.isatty():
        click.clear()
        room = shutil.get_terminal_size().lines - 1
        if len(lines) > room:
            lines = [*lines[: room - 1], "... the rest: dcam-ctl status"]
    else:
        lines = [*lines, ""]
    print("\n".join(lines), flush=True)


def print_status(facts: Facts, items: list[Item]) -> None:
    """Print what `status` shows people."""
    for line in status_lines(facts, items):
        print(line)


def status_lines(facts: Facts, items: list[Item]) -> Iterator[str]:
    """Give one line that a monitoring system shows, answers, a table, and last its figures."""
    for line in _lines_for_people(facts, items):
        yield line.replace("|", "/")  # figures follow a bar
    yield ""
    yield from hanging(["figures |"], [_WORD], _figures(facts))


def _lines_for_people(facts: Facts, items: list[Item]) -> Iterator[str]:
    level = worst(items)
    wrong = {item.text: item for item in items if item.level is level and level is not Level.OK}
    summary = "; ".join(f"{item.name}: {item.text}" for item in wrong.values()) or items[0].text
    yield one_line(f"DCAM {level.name} - {facts.site}: {summary}")
    yield ""
    for answer in answers(facts, items):
        yield from hanging([answer.word], [_WORD], answer.text, COLOURS[answer.level])
    yield ""
    now = "as of " + utc_text(facts.now_utc.replace(microsecond=0))
    yield from hanging(["what", "state"], [_NAME, _STATE], now)
    for item in items:
        words = [item.name, item.level.name.lower()]
        yield from hanging(words, [_NAME, _STATE], item.text, COLOURS[item.level])


def _figures(facts: Facts) -> str:
    """Performance data, as Nagios plugins give it."""
    figures = []
    last_utc = facts.last.slot_utc if facts.last else None
    for name, slot_utc in (("age", last_utc), ("good_age", facts.last_good_utc)):
        if slot_utc is not None:
            figures.append(f"{name}={(facts.now_utc - slot_utc).total_seconds():.0f}s")
    for name, coverage in (("24h", facts.coverage_24h), ("30d", facts.coverage_30d)):
        if coverage.expected:
            figures.append(f"coverage_{name}={100 * coverage.measured / coverage.expected:.2f}%")
    figures.append(f"disk_free={facts.disk.free_bytes}B")
    return " ".join(figures)


def status_fields(facts: Facts, items: list[Item]) -> dict[str, object]:
    """Everything for `--json`."""
    level = worst(items)
    calibration = facts.calibration
    return {
        "command": "status",
        "site": facts.site,
        "time_utc": facts.now_utc,
        "level": level.name.lower(),
        "code": int(level),
        "items": [
            {"name": item.name, "level": item.level.name.lower(), "text": item.text}
            for item in items
        ],
        "last": result_fields(facts.last.slot_utc, facts.last.measurement) if facts.last else None,
        "last_good_slot_utc": facts.last_good_utc,
        "temperatures_c": _temperatures(facts),
        "readings": _readings(facts),
        "calibration": None
        if calibration is None
        else {
            "id": calibration.id,
            "created_utc": calibration.created_utc,
            "method": calibration.method,
            "passed": calibration.passed,
            "fits_config": calibration.config_hash == facts.config_hash,
            "datum": None if calibration.datum is None else datum_fields(calibration.datum),
        },
        "closure_24h": asdict(facts.closure_24h) if facts.closure_24h else None,
        "closure_30d": asdict(facts.closure_30d) if facts.closure_30d else None,
        "targets": [_target_fields(target) for target in facts.targets],
        "coverage_24h": coverage_fields(facts.coverage_24h),
        "coverage_30d": coverage_fields(facts.coverage_30d),
        "gaps": [gap_fields(gap) for gap in facts.gaps],
        "daemon": asdict(facts.daemon),
        "disk": asdict(facts.disk),
        "databases_set_aside": facts.set_aside,
        "frames_not_kept_24h": facts.frames_not_kept_24h,
        "clock_synchronised": facts.clock_synchronised,
        "undated": facts.undated,
        "to_measure_again": facts.to_measure_again,
    }


def _target_fields(target: TargetSummary) -> dict[str, object]:
    return {
        **target_fields(target.now),
        "rows_24h": target.rows,
        "rows_with_value_24h": target.rows_with_value,
        "last_value_slot_utc": target.last_value_utc,
    }


def _temperatures(facts: Facts) -> dict[str, float | None]:
    """What the cameras said at the last row."""
    if facts.last is None:
        return {}
    cameras = {"main": facts.last.main_camera, "sub": facts.last.sub_camera}
    return {role: camera.temperature_c for role, camera in cameras.items()}


def _readings(facts: Facts) -> list[dict[str, object]]:
    """The sensors at the last row."""
    failed = facts.readings_failed
    return [
        {**asdict(one), "failed_since_utc": failed.get(one.name)}
        for one in (facts.last.readings if facts.last else ())
    ]


def coverage_fields(coverage: Coverage) -> dict[str, object]:
    """A coverage for `--json`."""
    return {
        "expected": coverage.expected,
        "good": coverage.good,
        "suspect": coverage.suspect,
        "bad": coverage.bad,
        "missing": coverage.missing,
        "gaps": coverage.gaps,
        "unaccounted": coverage.unaccounted,
    }
