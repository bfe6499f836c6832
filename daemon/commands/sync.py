"""`dcam-ctl sync`: copy the record of this site to the central database."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING

import click

from daemon.commands.options import Options, common_options, pass_options
from daemon.commands.output import note, progress, say
from daemon.config.outputs import FleetSection
from daemon.errors import DcamError

if TYPE_CHECKING:
    from daemon.store.central.connecting import Central


@click.command("sync", epilog="\b\nExample:\n  dcam-ctl sync\n  dcam-ctl sync --prepare")
@click.option(
    "--prepare",
    is_flag=True,
    help="Make or upgrade the central database's tables, once, as its owner; copy nothing.",
)
@common_options
@pass_options
def command(options: Options, prepare: bool) -> None:
    """Copy rows, gaps, calibrations, datums, ledger and events to the PostgreSQL of [fleet].

    Each row once, in the order in which they were written; how far a site has come stands beside
    the rows themselves, so that a cut at any moment, on either side, costs nothing. A timer runs
    this every 5 minutes. Reads the database beside dcamd, and never makes it wait: the site's own
    database stays the truth.
    """
    if prepare:
        _prepare(options.centre.fleet)
    elif options.config.fleet.url is None:
        say("nowhere to copy to: the config has no [fleet] url")
    else:
        _sync(options)


def _prepare(settings: FleetSection) -> None:
    from daemon.fleet.opening import address
    from daemon.store.central.connecting import connect_central, prepare

    central = connect_central(*address(settings))
    try:
        before, now = prepare(central)
    finally:
        central.close()
    done = "is up to date" if before == now else "made" if before is None else "upgraded"
    say(f"{central.name}: {done}, central revision {now}")


def _sync(options: Options) -> None:
    from daemon.fleet.opening import address
    from daemon.fleet.shared_config import shared_config
    from daemon.fleet.sync import Sync
    from daemon.store.central.writing import SiteFacts

    config = options.config
    facts = SiteFacts(
        config.name,
        config.schedule.period_s,
        config.site_section.position_deg,
        shared_config(config),
    )
    with progress(None, "copying rows") as steps:
        url, password = address(config.fleet)
        sync = Sync(url, password, options.state, facts, steps.at)
        copied = sync.run(lambda central, site_id: _put_status(options, central, site_id))
    outages = f", {copied.outages} outages" if copied.outages else ""
    note(f"{copied.rows} rows, {copied.events} events, {copied.others} others copied{outages}")


def _put_status(options: Options, central: Central, site_id: int) -> None:
    """Keep what `status` says here, for the list of all sites."""
    from daemon.alarm.armed import all_items, armed_alarms
    from daemon.commands.status_here import status_fields
    from daemon.plain import plain
    from daemon.status.facts import collect_facts
    from daemon.status.item import Level, worst
    from daemon.status.verdict import no_verdict
    from daemon.store.central.writing import Verdict, put_status

    raised: int | None = None
    try:
        facts = collect_facts(options.config, options.state, datetime.now(UTC))
        items = all_items(options.config, options.state, facts)
        level, fields = worst(items), plain(status_fields(facts, items))
        armed = armed_alarms(options.config, options.state, facts.now_utc)
        raised = sum(one.since_utc is not None for one in armed)
    except DcamError as error:
        items = [no_verdict(error)]
        level, fields = items[0].level, {}
    wrong = [item for item in items if item.level is level and level is not Level.OK]
    summary = "; ".join(f"{item.name}: {item.text}" for item in wrong) or items[0].text
    put_status(central, site_id, Verdict(int(level), summary, raised), fields)
