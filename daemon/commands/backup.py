"""`dcam-ctl backup FILE`: a consistent, checked copy of the database while the daemon runs."""

from __future__ import annotations

from pathlib import Path

import click

from daemon.commands.options import Options, common_options, json_option, pass_options, tz_option
from daemon.commands.output import print_json, progress, say
from daemon.commands.priority import lowest_priority
from daemon.store.copying import require_replaceable
from daemon.store.database import open_store_readonly
from daemon.text import bytes_text, utc_text


@click.command(
    "backup",
    epilog="\b\nExample:\n  dcam-ctl backup /media/usb/pier-3.db",
)
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--force", is_flag=True, help="Replace FILE also when it is no backup.")
@json_option
@tz_option
@common_options
@pass_options
def command(options: Options, file: Path, *, force: bool, as_json: bool) -> None:
    """Copy the database to FILE: rows, gaps, calibrations, events; no frames.

    The daemon goes on meanwhile and no slot waits. FILE appears only when the copy is complete,
    checked and on the disk; an older backup of that name is replaced, another file only with
    --force. To restore: stop dcamd, move dcam.db, dcam.db-wal and dcam.db-shm aside, copy FILE to
    dcam.db, start dcamd.
    """
    with lowest_priority(), open_store_readonly(options.state) as store:
        require_replaceable(file, force=force)
        with progress(1, "copying") as steps:
            copied = store.backup(file, steps.at)
    last = utc_text(copied.last_slot_utc) if copied.last_slot_utc else None
    if as_json:
        print_json(
            {
                "command": "backup",
                "file": file,
                "rows": copied.rows,
                "size_bytes": copied.size_bytes,
                "last_slot_utc": last,
            }
        )
    else:
        until = f" until {last}" if last else ""
        say(f"{file}: {copied.rows} rows{until}, {bytes_text(copied.size_bytes)}, checked")
