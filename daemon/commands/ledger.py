"""`dcam-ctl ledger`: what people say of spans of the record; measured rows are never touched."""

from __future__ import annotations

import getpass
import os
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any, TypeVar

import click

from core.site import MAIN
from daemon.commands.options import (
    Options,
    SuggestingGroup,
    common_options,
    json_option,
    only_reading_site,
    pass_options,
    site_option,
    span_options,
    tz_option,
)
from daemon.commands.output import print_json, print_table, say
from daemon.errors import UsageError
from daemon.store.database import open_store, open_store_readonly
from daemon.store.ledger.entries import (
    LedgerEntry,
    LedgerKind,
    in_force,
    read_ledger,
    undone,
)
from daemon.store.ledger.fields import entry_fields, span_fields
from daemon.store.runs import next_second
from daemon.text import utc_text

Function = TypeVar("Function", bound=Callable[..., Any])


@click.group(
    "ledger",
    cls=SuggestingGroup,
    invoke_without_command=True,
    epilog="\b\nExample:\n  dcam-ctl ledger\n"
    "  dcam-ctl ledger exclude --since 2026-05-15 --until 2026-05-16 'plate being painted'\n"
    "  dcam-ctl ledger undo 3 'it was another plate'",
)
@json_option
@tz_option
@site_option
@common_options
@click.pass_context
def command(ctx: click.Context, as_json: bool) -> None:
    """List what holds: spans that are annotated or excluded, with who said so and why.

    Entries are only ever added. What was wrong is taken back with undo, which stays in the history,
    as does the entry. Rows are never changed. What is excluded raises no alarm and is left out of
    analyse and compare; plot hatches it, report gives the months with and without it, export marks
    it.
    """
    if ctx.invoked_subcommand is not None:
        if as_json:
            msg = f"give --json behind {ctx.invoked_subcommand}"
            raise UsageError(msg)
        only_reading_site(ctx)
        return
    _show(ctx.ensure_object(Options), as_json=as_json, history=False)


@command.command("history", epilog="\b\nExample:\n  dcam-ctl ledger history --json")
@json_option
@tz_option
@site_option
@common_options
@pass_options
def history_command(options: Options, as_json: bool) -> None:
    """List all entries, oldest first: comments and what was taken back too."""
    _show(options, as_json=as_json, history=True)


def author_option(function: Function) -> Function:
    """Add `--by NAME`; the command gets it as `author`."""
    return click.option(
        "--by",
        "author",
        default=_user,
        show_default="who is logged in",
        metavar="NAME",
        callback=_words,
        help="Who says so.",
    )(function)


def _user() -> str:
    return os.environ.get("SUDO_USER") or getpass.getuser()


def _words(_ctx: click.Context, _parameter: click.Parameter, text: str) -> str:
    """Pass a text on without blanks around it. Raises click.BadParameter for an empty one."""
    if not text.strip():
        msg = "say it in words"
        raise click.BadParameter(msg)
    return text.strip()


def _span_command(kind: LedgerKind, text: str, example: str) -> None:
    """Add the command that enters a span."""

    @command.command(kind.value, help=text, epilog=f"\b\nExample:\n  dcam-ctl ledger {example}")
    @span_options
    @click.option(
        "--point",
        metavar="NAME",
        help="main, or the name of a further target; default: all targets.",
    )
    @author_option
    @json_option
    @common_options
    @click.argument("reason", metavar="TEXT", callback=_words)
    @pass_options
    def enter(
        options: Options,
        since: datetime | None,
        until: datetime | None,
        point: str | None,
        author: str,
        as_json: bool,
        reason: str,
    ) -> None:
        if since is None or until is None:
            msg = "give --since and --until: the span that this is said of"
            raise UsageError(msg)
        begin, end = next_second(since), next_second(until)
        if begin == end:
            msg = "--since and --until are the same second: the span is empty"
            raise UsageError(msg)
        if point is not None:
            _require_known(options, point)
        entry = LedgerEntry(kind, author, datetime.now(UTC), reason, begin, end, point)
        _add(options, entry, as_json=as_json)


def _require_known(options: Options, point: str) -> None:
    known = [MAIN, *(extra.name for extra in options.config.target.extra)]
    if point not in known:
        msg = f"--point {point}: the config has {', '.join(known)}"
        raise UsageError(msg)


_span_command(
    LedgerKind.ANNOTATE,
    "Say what happened in a span of the record.",
    "annotate --since 2026-05-15T08:00 --until 2026-05-15T17:00 'slab cast'",
)
_span_command(
    LedgerKind.EXCLUDE,
    "Leave a span's values out of analyses and alarms; the rows stay as they are.",
    "exclude --since 2026-05-15 --until 2026-05-16 'plate being painted'",
)


def _answer_command(kind: LedgerKind, text: str, example: str) -> None:
    """Add the command that answers an entry."""

    @command.command(kind.value, help=text, epilog=f"\b\nExample:\n  dcam-ctl ledger {example}")
    @author_option
    @json_option
    @common_options
    @click.argument("number", metavar="N", type=click.IntRange(min=1))
    @click.argument("reason", metavar="TEXT", callback=_words)
    @pass_options
    def answer(options: Options, author: str, as_json: bool, number: int, reason: str) -> None:
        entry = LedgerEntry(kind, author, datetime.now(UTC), reason, entry_id=number)
        _add(options, entry, as_json=as_json)


_answer_command(
    LedgerKind.COMMENT,
    "Add a comment to entry N.",
    "comment 3 'see the contractor''s diary, page 12'",
)
_answer_command(
    LedgerKind.UNDO,
    "Take entry N back; an undo can be taken back as well.",
    "undo 3 'it was another plate'",
)


def _add(options: Options, entry: LedgerEntry, *, as_json: bool) -> None:
    with open_store(options.state, create=False, migrate=False) as store:
        entry = replace(entry, id=store.add_ledger_entry(entry))
    if as_json:
        print_json({"command": "ledger", "entry": entry_fields(entry, {})})
    else:
        say(f"entry {entry.id}: {_what(entry)}")


def _show(options: Options, *, as_json: bool, history: bool) -> None:
    with open_store_readonly(options.state) as store:
        entries = read_ledger(store.path)
    gone = undone(entries)
    shown = entries if history else in_force(entries)
    if as_json:
        print_json(
            {
                "command": "ledger",
                "entries": [entry_fields(entry, gone) for entry in shown],
                "excluded": span_fields(entries),
            }
        )
        return
    if not shown:
        say("the ledger is empty" if not entries else "nothing holds: dcam-ctl ledger history")
        return
    answers = {entry.entry_id for entry in entries if entry.kind is LedgerKind.COMMENT}
    print_table(
        ("no", "entered", "by", "what", "text"),
        [
            (
                str(entry.id),
                utc_text(entry.created_utc.replace(microsecond=0)),
                entry.author,
                _what(entry) + _fate(entry, gone),
                entry.text + (" (commented)" if not history and entry.id in answers else ""),
            )
            for entry in shown
        ],
    )


def _what(entry: LedgerEntry) -> str:
    """An entry without who, when and why."""
    if entry.since_utc is None or entry.until_utc is None:
        return f"{entry.kind.value} {entry.entry_id}"
    last_utc = entry.until_utc - timedelta(seconds=1)
    of = f", {entry.point} only" if entry.point else ""
    return f"{entry.kind.value} {utc_text(entry.since_utc)} to {utc_text(last_utc)}{of}"


def _fate(entry: LedgerEntry, gone: dict[int, LedgerEntry]) -> str:
    undo = None if entry.id is None else gone.get(entry.id)
    return "" if undo is None else f" (taken back by {undo.id})"
