"""`dcam-ctl alarm`: judge the site once, and send a message where something is wrong."""

from __future__ import annotations

import getpass
import os
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import click

from daemon.alarm.armed import armed_alarms
from daemon.alarm.history import alarm_history
from daemon.alarm.kept import only_one
from daemon.alarm.look import Place, find_wrong, look
from daemon.alarm.memory import read_memory
from daemon.alarm.operator_actions import acknowledge, end_silence, silence
from daemon.alarm.receivers import NotAcceptedError, Receiver, receivers
from daemon.alarm.wrong import alarm_name
from daemon.commands.durations import duration_s
from daemon.commands.options import (
    Options,
    SuggestingGroup,
    at_option,
    common_options,
    json_option,
    pass_options,
    span_options,
    tz_option,
)
from daemon.commands.output import note, print_json, print_table, say
from daemon.config.alarm import read_remains
from daemon.config.file import find_config, find_state
from daemon.config.reading import DEFAULT_STATE_DIRECTORY, Config, find_installation
from daemon.errors import ConfigError, ExitCode, UsageError
from daemon.text import count_of, utc_text

LOCK_NAME = "alarm.lock"


@click.group(
    "alarm",
    cls=SuggestingGroup,
    invoke_without_command=True,
    epilog="\b\nExample:\n  dcam-ctl alarm --test\n  dcam-ctl alarm list\n"
    "  dcam-ctl alarm ack midspan-low --note 'crew is on its way'\n"
    "  dcam-ctl alarm silence 2h",
)
@click.option("--test", is_flag=True, help="Send a message now, and print who accepted it.")
@at_option
@tz_option
@common_options
@click.pass_context
def command(ctx: click.Context, test: bool, at_utc: datetime | None) -> int:
    """Judge the site once, as status does, and send what has been wrong for too long.

    A message is sent when something goes wrong, again after repeat_h, and when it is over;
    dcam-alarm.timer runs this every minute. Exit code 4: a receiver did not accept its message,
    which is sent again the next time. With --test, 3: [alarm] names nobody.
    """
    if ctx.invoked_subcommand is not None:
        if test or at_utc is not None:
            msg = f"--test and --at are not for alarm {ctx.invoked_subcommand}"
            raise UsageError(msg)
        return ExitCode.DONE
    place = _find(ctx.ensure_object(Options))
    everyone = receivers(place.settings)
    if not everyone and test:
        where = find_config(ctx.ensure_object(Options).config_flag)
        msg = f"{where}: [alarm] names nobody to tell; set its urls = [...] or command = [...]"
        raise ConfigError(msg)
    if not everyone and not place.settings.own:
        say("nobody to tell: [alarm] in the config names neither urls nor a command")
        return ExitCode.DONE
    now_utc = at_utc or datetime.now(UTC)
    if test:
        return _try_all(everyone, place.site, now_utc)
    with only_one(place.state, LOCK_NAME, wait=False) as free:
        if free:
            return _look(place, everyone, now_utc)
    say("another look is in progress: it tells whoever must know")
    return ExitCode.DONE


def _look(place: Place, everyone: Sequence[Receiver], now_utc: datetime) -> ExitCode:
    kept, complaint = read_memory(place.state)
    if complaint:
        note(complaint)
    found = find_wrong(place, kept, now_utc)
    for one in found.wrong:
        say(f"{one.name}: {one.level.name.lower()}: {one.text}")
    if not found.wrong:
        say("nothing is wrong")
    outcomes = look(place, everyone, found, kept, now_utc)
    for line in outcomes.lines:
        note(line)
    return ExitCode.HARDWARE if outcomes.failed else ExitCode.DONE


def _find(options: Options) -> Place:
    """Find out whom to tell, also from a config that is wrong elsewhere. Raises ConfigError."""
    try:
        found = find_installation(options.config_flag, options.state_flag)
    except ConfigError as error:
        path = find_config(options.config_flag)
        remains = read_remains(path)
        if remains is None:
            raise
        named = remains.storage.directory
        directory = path.absolute().parent / named if named else DEFAULT_STATE_DIRECTORY
        state = find_state(options.state_flag, directory)
        return Place(remains.site.name, remains.alarm, state, error)
    return Place(found.config.name, found.config.alarm, found.state_directory, found.config)


def _try_all(everyone: Sequence[Receiver], site: str, now_utc: datetime) -> ExitCode:
    """Send each receiver a test."""
    when = utc_text(now_utc.replace(microsecond=0))
    words = f"A test, sent at {when}, of whether alarms arrive. Nothing is wrong."
    taken = [_send(receiver, f"dcam {site}: test", words) for receiver in everyone]
    return ExitCode.DONE if all(taken) else ExitCode.HARDWARE


def _send(receiver: Receiver, headline: str, words: str) -> bool:
    try:
        receiver.send(headline, words)
    except NotAcceptedError as error:
        note(f"alarm.{receiver.name} did not accept {headline!r}: {error}")
        return False
    note(f"alarm.{receiver.name} accepted {headline!r}")
    return True


# --------------------------------------------------------------- what people say to it, and see


def _user() -> str:
    """Who runs this, behind sudo too."""
    named = os.environ.get("SUDO_USER")
    if named:
        return named
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # a user without a name
        return f"uid {os.getuid()}"


def _names(config: Config, given: Sequence[str], options: Options) -> list[str]:
    """The alarms that are meant. Raises UsageError."""
    names = [alarm_name(name) for name in given]
    known = [one.name for one in armed_alarms(config, options.state, datetime.now(UTC))]
    for name in names:
        if name not in known:
            msg = f"no alarm is called {name!r}; they are: {', '.join(known)}"
            raise UsageError(msg)
    return names


by_option = click.option("--by", metavar="WHO", help="Your name; default: the user's.")
note_option = click.option("--note", "remark", metavar="TEXT", default="", help="Why.")


@command.command("ack", epilog="\b\nExample:\n  dcam-ctl alarm ack disk --note 'new disk ordered'")
@click.argument("names", metavar="NAME...", nargs=-1, required=True)
@by_option
@note_option
@at_option
@common_options
@pass_options
def ack_command(
    options: Options, names: tuple[str, ...], by: str | None, remark: str, at_utc: datetime | None
) -> None:
    """Acknowledge alarms that are raised: they are not repeated until they are over, or worse.

    Everybody still hears when they are over. The next time they are raised is a new alarm.
    """
    chosen = [alarm_name(name) for name in names]
    acknowledge(options.state, chosen, by or _user(), remark, at_utc or datetime.now(UTC))
    say(f"acknowledged: {', '.join(chosen)}")


@command.command(
    "silence",
    epilog="\b\nExample:\n  dcam-ctl alarm silence 2h --note 'painting the railing'\n"
    "  dcam-ctl alarm silence 3d coverage-24-h cameras\n  dcam-ctl alarm silence end",
)
@click.argument("duration", metavar="DURATION")
@click.argument("names", metavar="[NAME...]", nargs=-1)
@by_option
@note_option
@at_option
@common_options
@pass_options
def silence_command(
    options: Options,
    duration: str,
    names: tuple[str, ...],
    by: str | None,
    remark: str,
    at_utc: datetime | None,
) -> None:
    """Send nothing of some alarms, or of all, for a while that ends by itself.

    DURATION is 30m, 2h, 3d, or `end`, which ends what is silenced now. What is still wrong when
    the silence ends is sent then; what began and ended within it is in the history only.
    """
    chosen = _names(options.config, names, options)
    now_utc, who = at_utc or datetime.now(UTC), by or _user()
    if duration == "end":
        count = end_silence(options.state, chosen, who, now_utc)
        say(f"{count_of(count, 'silence')} ended")
        return
    until_utc = silence(options.state, chosen, _duration(duration), who, remark, now_utc)
    what = ", ".join(chosen) or "all alarms"
    say(f"silent until {utc_text(until_utc.replace(microsecond=0))}: {what}")


def _duration(text: str) -> timedelta:
    seconds = duration_s(text)
    if seconds is None:
        msg = f"{text!r} is no duration such as 30m, 2h, 3d, nor end"
        raise UsageError(msg)
    return timedelta(seconds=seconds)


@command.command("list", epilog="\b\nExample:\n  dcam-ctl alarm list --json")
@at_option
@json_option
@tz_option
@common_options
@pass_options
def list_command(options: Options, at_utc: datetime | None, as_json: bool) -> None:
    """Show each alarm: armed, raised since when, acknowledged by whom, silent until when."""
    now_utc = at_utc or datetime.now(UTC)
    found = armed_alarms(options.config, options.state, now_utc)
    if as_json:
        print_json({"command": "alarm list", "alarms": [one.fields() for one in found]})
        return
    rows = []
    for one in found:
        said = [one.text or one.about]
        if one.since_utc:
            said.insert(0, f"since {utc_text(one.since_utc.replace(microsecond=0))}")
        if one.acknowledged_by:
            said.append(f"known to {one.acknowledged_by}")
        if one.silent_until_utc:
            said.append(f"silent until {utc_text(one.silent_until_utc.replace(microsecond=0))}")
        if one.note:
            said.append(one.note)
        rows.append((one.name, one.state, one.level.name.lower(), "; ".join(said)))
    print_table(("alarm", "state", "from", "what"), rows)


@command.command("history", epilog="\b\nExample:\n  dcam-ctl alarm history --since 2026-03-01")
@span_options
@json_option
@common_options
@pass_options
def history_command(
    options: Options, since: datetime | None, until: datetime | None, as_json: bool
) -> None:
    """Show what became of alarms: raised, sent, failed, acknowledged, silenced, cleared."""
    found = alarm_history(options.state, since, until)
    if as_json:
        print_json({"command": "alarm history", "history": [one.fields() for one in found]})
        return
    rows = [
        (utc_text(one.time_utc.replace(microsecond=0)), one.kind, one.name, one.by, one.text)
        for one in found
    ]
    print_table(("time", "what", "alarm", "who", "text"), rows)
