"""`dcam-ctl datum`: the record's one zero, and what it rests on from calibration to calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import click

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
from daemon.errors import UsageError, WorkFailedError
from daemon.store.database import Store, open_store, open_store_readonly
from daemon.store.queries.datum_fields import datum_fields, sigmas_mm
from daemon.store.records import CalibrationRecord, DatumRecord
from daemon.text import utc_text

Links = Mapping[int, DatumRecord]


def _number(_ctx: click.Context, _parameter: click.Parameter, value: float | None) -> float | None:
    """Pass a number on. Raises click.BadParameter for nan and inf."""
    if value is not None and not math.isfinite(value):
        msg = f"{value} is no length in mm"
        raise click.BadParameter(msg)
    return value


@click.group(
    "datum",
    cls=SuggestingGroup,
    invoke_without_command=True,
    epilog="\b\nExample:\n  dcam-ctl datum\n"
    "  dcam-ctl datum set --y 12.3 --sigma 0.5 --source levelling\n"
    "  dcam-ctl datum adjust --since 2026-05-15 --until 2026-05-18",
)
@json_option
@tz_option
@site_option
@common_options
@click.pass_context
def command(ctx: click.Context, as_json: bool) -> None:
    """Show where the reference of each calibration lies in the record's zero, and why.

    The zero is the reference of the first calibration. Each later one has an offset from it, which
    is added to all its rows wherever they are read; the sigma grows from link to link. Nothing that
    was measured is changed: a better offset is a new link, and the newest link holds.
    """
    if ctx.invoked_subcommand is not None:
        if as_json:
            msg = f"give --json behind {ctx.invoked_subcommand}"
            raise UsageError(msg)
        only_reading_site(ctx)
        return
    options = ctx.ensure_object(Options)
    with open_store_readonly(options.state) as store:
        made, links = store.calibrations(), _newest(store)
    if not made:
        msg = f"{options.state}: no calibration yet"
        raise WorkFailedError(msg)
    if as_json:
        print_json({"command": "datum", "calibrations": [_fields(one, links) for one in made]})
    else:
        _print_chain(made, links)


@command.command(
    "set",
    epilog="\b\nExample:\n  dcam-ctl datum set --y 12.3 --sigma 0.5 --source levelling\n"
    "  dcam-ctl datum set --calibration 2 --x 0 --y -3.1 --sigma 0.2 --source 'total station'",
)
@click.option(
    "--x",
    "x_mm",
    type=float,
    callback=_number,
    metavar="MM",
    help="To the right; left as it is without.",
)
@click.option(
    "--y",
    "y_mm",
    type=float,
    callback=_number,
    metavar="MM",
    help="Upwards; left as it is without.",
)
@click.option(
    "--sigma",
    "sigma_mm",
    type=click.FloatRange(0, min_open=True),
    callback=_number,
    metavar="MM",
    required=True,
    help="1 sigma of what is given.",
)
@click.option("--source", metavar="TEXT", required=True, help="Where it is from.")
@click.option(
    "--calibration",
    "calibration_id",
    type=click.IntRange(min=1),
    metavar="ID",
    help="Whose reference it is of; default: the active one.",
)
@json_option
@common_options
@pass_options
def set_command(
    options: Options,
    x_mm: float | None,
    y_mm: float | None,
    sigma_mm: float,
    source: str,
    calibration_id: int | None,
    as_json: bool,
) -> None:
    """Enter where the target was at a calibration's reference, in the record's zero, by a survey.

    Calibrations that were linked through this one follow it.
    """
    from daemon.datum.chain import relinked
    from daemon.datum.survey import surveyed

    if x_mm is None and y_mm is None:
        msg = "give --x, --y or both"
        raise UsageError(msg)
    now_utc = datetime.now(UTC)
    with open_store(options.state, create=False, migrate=False) as store:
        number, links = _chosen(store, calibration_id, options.state), _newest(store)
        given = surveyed(links.get(number), x_mm, y_mm, sigma_mm, source, now_utc)
        _store(store, relinked(links, {number: given}, now_utc), as_json=as_json)


@command.command(
    "adjust",
    epilog="\b\nExample:\n  dcam-ctl datum adjust\n"
    "  dcam-ctl datum adjust --calibration 3 --with 2 --from /data/both",
)
@click.option(
    "--from",
    "directory",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="DIR",
    help="Measure the rows of role measure of a frame set; without it the frames that were kept.",
)
@click.option(
    "--calibration",
    "later_id",
    type=click.IntRange(min=1),
    metavar="ID",
    help="The later calibration; default: the active one.",
)
@click.option(
    "--with",
    "earlier_id",
    type=click.IntRange(min=1),
    metavar="ID",
    help="The earlier one; default: that which the later one is linked to.",
)
@click.option(
    "--board-untouched",
    is_flag=True,
    help="Believe the frames also where the present link contradicts them: board, lenses and "
    "cameras were not touched between the two calibrations.",
)
@span_options
@json_option
@common_options
@pass_options
def adjust_command(
    options: Options,
    directory: Path | None,
    later_id: int | None,
    earlier_id: int | None,
    board_untouched: bool,
    since: datetime | None,
    until: datetime | None,
    as_json: bool,
) -> None:
    """Measure the same frames with two calibrations, and adjust the chain to what they say.

    Board, lenses and cameras must not have been touched between the two. By default the kept
    frames next to the later reference are measured. Where no frames tell, as with another camera,
    the rows of the week before and after are compared. All links are adjusted together, by least
    squares.
    """
    from daemon.commands.datum_adjust import Wanted, adjusted

    if directory is not None and (since or until):
        msg = "--since and --until choose kept frames; leave them out with --from"
        raise UsageError(msg)
    with open_store(options.state, create=False, migrate=False) as store:
        later = _chosen(store, later_id, options.state)
        links = _newest(store)
        earlier = earlier_id or _before(later, links, options.state)
        wanted = Wanted(earlier, later, directory, since, until, board_untouched)
        _store(store, adjusted(options, store, links, wanted), as_json=as_json)


def _newest(store: Store) -> dict[int, DatumRecord]:
    return {int(link.calibration_id or 0): link for link in store.datum_links()}


def _chosen(store: Store, calibration_id: int | None, state: Path) -> int:
    """A calibration by its number, or the active one. Raises WorkFailedError."""
    found = (
        store.active_calibration() if calibration_id is None else store.calibration(calibration_id)
    )
    if found is None or found.id is None:
        which = "active calibration" if calibration_id is None else f"calibration {calibration_id}"
        msg = f"{state}: no {which}; dcam-ctl datum lists those there are"
        raise WorkFailedError(msg)
    return found.id


def _before(later: int, links: Links, state: Path) -> int:
    """The calibration that a later one is linked to, else the one stored before it."""
    linked = [step.from_id for step in links[later].steps] if later in links else []
    before = next((number for number in linked if number is not None), later - 1)
    if before < 1:
        msg = f"{state}: no calibration before {later}: nothing to adjust it to"
        raise WorkFailedError(msg)
    return before


def _store(store: Store, changed: Links, *, as_json: bool) -> None:
    """Store new links, all or none, and show them."""
    store.add_datums(changed)
    made, links = store.calibrations(), _newest(store)
    if as_json:
        print_json({"command": "datum", "calibrations": [_fields(one, links) for one in made]})
        return
    _print_chain(made, links)
    say("changed: " + ", ".join(f"calibration {number}" for number in sorted(changed)))


def _fields(made: CalibrationRecord, links: Links) -> dict[str, object]:
    """A calibration's link for `--json`; without one its offset is not known."""
    link = links.get(made.id or 0)
    if link is None:
        return {"calibration": made.id, "created_utc": made.created_utc, "method": None}
    return datum_fields(link)


def _print_chain(made: Sequence[CalibrationRecord], links: Links) -> None:
    """Print a line for each calibration."""
    print_table(
        ("calibration", "reference", "x mm", "y mm", "how", "detail"),
        [_line(one, links.get(one.id or 0)) for one in made],
    )


def _line(made: CalibrationRecord, link: DatumRecord | None) -> tuple[str, ...]:
    if link is None:
        made_utc = utc_text(made.created_utc.replace(microsecond=0))
        detail = "its rows count from its own reference; dcam-ctl datum set or adjust"
        return (str(made.id), made_utc, "", "", "not linked", detail)
    when_utc = link.reference_utc or link.created_utc.replace(microsecond=0)
    x_mm, y_mm = (
        f"{value:+.3f} ± {sigma:.2g}"
        for value, sigma in zip(link.offset.mm, sigmas_mm(link.offset), strict=True)
    )
    return (str(made.id), utc_text(when_utc), x_mm, y_mm, link.method.value, link.detail)
