"""`dcam-ctl check`: everything that must be right before the first slot, each with what to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict

import click

from daemon.checks.alarm import check_alarm
from daemon.checks.computer import check_clock, check_computer, check_user
from daemon.checks.devices import check_backend, check_cameras, check_head, check_links
from daemon.checks.disk import check_room, check_speed
from daemon.checks.drawing import check_drawing
from daemon.checks.finding import Finding, failed
from daemon.checks.long_look import check_long
from daemon.checks.readings import check_readings
from daemon.checks.record import check_database, check_state
from daemon.checks.report import check_report
from daemon.checks.serial_port import check_port_rivals
from daemon.checks.web import check_web
from daemon.commands.options import Options, common_options, json_option, pass_options, tz_option
from daemon.commands.output import print_json, print_table
from daemon.config.reading import Installation
from daemon.config.report import ReportSection
from daemon.errors import ExitCode, HardwareError, WorkFailedError


@click.command("check", epilog="\b\nExample:\n  dcam-ctl --config dcam.toml check --hardware")
@click.option(
    "--hardware",
    is_flag=True,
    help="Look at the computer, its links to the cameras, the head and the disk too, and take a "
    "pair; a running dcamd takes it between two slots.",
)
@click.option(
    "--long",
    "is_long",
    is_flag=True,
    help="With --hardware and dcamd stopped: take 20 pairs over more than two minutes, and report "
    "what only the real cameras know; send this with a first report from new hardware.",
)
@json_option
@tz_option
@common_options
@pass_options
def command(options: Options, hardware: bool, is_long: bool, as_json: bool) -> int:
    """Check config, geometry, state, database, calibration, clock, alarm, report and sensors.

    Also the room on the disk and who may see the page; with --hardware the computer, cameras, head
    and how fast the disk is. Each line is ok, warning or error, and says what to do. Nothing is
    changed; a file that is written to try the disk is removed again. The exit code is that of the
    first error, 0 when there is none.
    """
    if is_long and not hardware:
        msg = "--long: only with --hardware"
        raise click.UsageError(msg)
    findings = list(_findings(options.installation, hardware=hardware, is_long=is_long))
    if as_json:
        print_json({"command": "check", "findings": [_fields(finding) for finding in findings]})
    else:
        print_table(("what", "state", "text"), [(f.name, f.state, f.text) for f in findings])
    return next((f.exit_code for f in findings if f.state == "error"), ExitCode.DONE)


def _findings(site: Installation, *, hardware: bool, is_long: bool) -> Iterator[Finding]:
    config, state = site.config, site.state_directory
    yield Finding("config", "ok", f"{site.config_path}, site {config.name}")
    yield from check_drawing(config.site())
    yield check_state(site)
    yield check_room(config, state)
    yield from check_database(site)
    yield check_clock(simulated=config.has_stepped_clock)
    yield from check_alarm(config.alarm, site.config_path, config.schedule.period_s)
    yield from check_report(config.report, state)
    yield from _check_reference(config.report)
    yield from check_web(config.web, site.config_path)
    yield check_backend(config)
    yield from check_readings(config)
    if not hardware:
        return
    yield check_user(state)
    yield from check_links(config)
    if is_long:  # first: whoever opens a camera sets right what another program left in it
        yield from check_long(site)
    yield from check_cameras(site)
    yield from check_port_rivals(config)
    yield from check_head(config)
    yield from check_speed(config, state)
    yield from check_computer()


def _check_reference(settings: ReportSection) -> Iterator[Finding]:
    """Whether the reference that reports are compared with can be read."""
    if settings.reference is None:
        return
    from daemon.reports.reference import read_reference

    try:
        measured = read_reference(settings.reference)
    except (HardwareError, WorkFailedError) as error:
        yield failed("reference", error)
        return
    times = sum(map(len, measured.series.values()))
    text = f"{settings.reference}: {times} values of {', '.join(measured.points)}"
    yield Finding("reference", "ok", text)


def _fields(finding: Finding) -> dict[str, object]:
    return {**asdict(finding), "exit_code": int(finding.exit_code)}
