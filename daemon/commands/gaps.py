"""`dcam-ctl gaps`: slots without a measurement, and why."""

from __future__ import annotations

from datetime import datetime

import click

from daemon.commands.options import (
    Options,
    common_options,
    json_option,
    pass_options,
    site_option,
    span_options,
)
from daemon.commands.output import gap_fields, print_json, print_table, say
from daemon.store.database import ALWAYS, NEVER, open_store_readonly
from daemon.store.records import GapRecord
from daemon.text import count_of, utc_text


@click.command("gaps", epilog="\b\nExample:\n  dcam-ctl gaps --since 30d")
@span_options
@json_option
@site_option
@common_options
@pass_options
def command(
    options: Options, since: datetime | None, until: datetime | None, as_json: bool
) -> None:
    """List slots without a measurement: first and last missed slot, how many, cause."""
    with open_store_readonly(options.state) as store:
        gaps = store.gaps(since or ALWAYS, until or NEVER)
    if as_json:
        print_json({"command": "gaps", "gaps": [gap_fields(gap) for gap in gaps]})
    else:
        print_gaps(gaps)


def print_gaps(gaps: list[GapRecord]) -> None:
    """Print gaps as a table with their sum below it."""
    if not gaps:
        say("no gaps")
        return
    print_table(
        ("first slot", "last slot", "slots", "cause", "detail"),
        [
            (
                utc_text(gap.first_slot_utc),
                utc_text(gap.last_slot_utc),
                str(gap.slots),
                gap.cause.value,
                gap.detail,
            )
            for gap in gaps
        ],
    )
    slots = sum(gap.slots for gap in gaps)
    say(f"{count_of(len(gaps), 'gap')}, {count_of(slots, 'slot')} missed")
