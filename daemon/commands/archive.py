"""`dcam-ctl archive`: closed months of all sites, from the central database to Parquet."""

from __future__ import annotations

from datetime import UTC, datetime

import click

from daemon.commands.options import Options, common_options, pass_options, utc_time
from daemon.commands.output import note, progress
from daemon.errors import UsageError
from drivers.errors import MissingLibraryError
from drivers.libraries import has_library

_FIRST = datetime(2000, 1, 1, tzinfo=UTC)


@click.command(
    "archive",
    epilog="\b\nExample:\n  dcam-ctl archive --to s3://bucket/dcam\n"
    "  dcam-ctl archive --to /srv/dcam-archive --since 400d",
)
@click.option("--to", "place", metavar="URL", help="A directory or URL; else [fleet] archive.")
@click.option(
    "--since",
    callback=utc_time,
    metavar="TIME",
    help="Look at months from this time on only; default: at all months.",
)
@common_options
@pass_options
def command(options: Options, place: str | None, since: datetime | None) -> None:
    """Write closed months of the central database's rows as Parquet, one file a site and month.

    A month is closed once a row of a later one is there. What is written already stays, and is not
    read again, unless rows came late: then its file is replaced as a whole. Run it again at any
    time, also after it was cut off. For DuckDB, pandas and others: docs/fleet.md says how. Needs
    pyarrow, and fsspec for a URL.
    """
    from daemon.fleet.archive import write_archive
    from daemon.fleet.opening import opened

    settings = options.centre.fleet
    place = place or settings.archive
    if place is None:
        msg = "give --to URL, or archive in [fleet]: where the months are to be written"
        raise UsageError(msg)
    if not has_library("pyarrow"):
        msg = (
            "no Parquet: pyarrow is not installed; docs/fleet.md says how to make the environment "
            "that archive runs in, on any computer that reaches the central database"
        )
        raise MissingLibraryError(msg)
    with opened(settings) as central, progress(None, "writing months") as steps:
        done = write_archive(central, place, since or _FIRST, steps.at)
    for part in done.fewer:
        note(
            f"{part}: fewer rows are there now than were written: its file stays; to have it "
            "written from what is there, remove its line in written/"
        )
    size = f", {done.size / done.rows:.0f} bytes a row" if done.rows else ""
    note(
        f"{done.months} months of sites written with {done.rows} rows{size}; "
        f"{done.kept} were there; {done.small} tables of datums, gaps and ledgers"
    )
