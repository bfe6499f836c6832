"""`dcam-ctl alarm`: judge the site once, and send a message where something is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import click

from daemon.alarm.memory import keep_memory, read_memory
from daemon.alarm.receivers import NotAcceptedError, Receiver, receivers
from daemon.alarm.rules import Memory, due, seen, text, title, with_sent, wrong
from daemon.commands.options import Options, at_option, common_options, pass_options, tz_option
from daemon.commands.output import note, say, shown_zone
from daemon.config.alarm import AlarmSection, read_remains
from daemon.config.reading import (
    DEFAULT_STATE_DIRECTORY,
    Config,
    find_config,
    find_installation,
    find_state,
)
from daemon.error_report import lines_of
from daemon.errors import ConfigError, ExitCode
from daemon.status.facts import collect_facts
from daemon.status.item import Item
from daemon.status.verdict import judge, no_verdict
from daemon.text import utc_text
from daemon.zones import in_zone


@click.command(
    "alarm",
    epilog="\b\nExample:\n  dcam-ctl alarm --test\n  dcam-ctl alarm",
)
@click.option("--test", is_flag=True, help="Send a message now, and print who accepted it.")
@at_option
@tz_option
@common_options
@pass_options
def command(options: Options, test: bool, at_utc: datetime | None) -> int:
    """Judge the site once, as status does, and send what has been wrong for too long.

    A message is sent when something goes wrong, again after repeat_h, and when all is well again;
    dcam-alarm.timer runs this every five minutes. Exit code 4: a receiver did not accept its
    message, which is sent again the next time. With --test, 3: [alarm] names nobody.
    """
    place = _find(options)
    everyone = receivers(place.settings)
    if not everyone and test:
        where = find_config(options.config_flag)
        msg = f"{where}: [alarm] names nobody to tell; set its urls = [...] or command = [...]"
        raise ConfigError(msg)
    if not everyone:
        say("nobody to tell: [alarm] in the config names neither urls nor a command")
        return ExitCode.DONE
    now_utc = at_utc or datetime.now(UTC)
    if test:
        return _try_all(everyone, place.site, now_utc)
    items, whole = _wrong_items(place, now_utc)
    for item in items:
        say(f"{item.name}: {item.level.name.lower()}: {item.text}")
    if not items:
        say("nothing is wrong")
    return _tell_all(everyone, place, items, now_utc, whole=whole)


@dataclass(frozen=True, slots=True)
class Place:
    """The site, as far as its config can be read."""

    site: str
    settings: AlarmSection
    state: Path
    config: Config | ConfigError


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


def _wrong_items(place: Place, now_utc: datetime) -> tuple[list[Item], bool]:
    """Give what is wrong, and whether everything could be looked at."""
    if isinstance(place.config, ConfigError):
        return [no_verdict(place.config)], False
    try:
        items = judge(collect_facts(place.config, place.state, now_utc))
    except Exception as error:  # noqa: BLE001 - whatever hides how the site is must be sent
        return [no_verdict(error)], False
    return wrong(items, place.settings), True


def _tell_all(
    everyone: Sequence[Receiver],
    place: Place,
    items: Sequence[Item],
    now_utc: datetime,
    *,
    whole: bool,
) -> ExitCode:
    """Tell each receiver what is due; remember at once, so that no end of this tells it twice."""
    kept, complaint = read_memory(place.state)
    if complaint:
        note(complaint)
    code = ExitCode.DONE
    memory = seen(kept, items, now_utc, {receiver.key for receiver in everyone}, whole=whole)
    for receiver in everyone:
        news = due(memory, receiver.key, items, place.settings, now_utc)
        if news is None:
            continue
        headline = title(news, place.site, items)
        if not _send(receiver, headline, text(memory, items, now_utc)):
            code = ExitCode.HARDWARE
            continue
        memory = with_sent(memory, receiver.key, items, now_utc)
        kept, code = _keep(place.state, kept, memory, code)
    return _keep(place.state, kept, memory, code)[1]


def _keep(state: Path, kept: Memory, memory: Memory, code: ExitCode) -> tuple[Memory, ExitCode]:
    """Write the memory if it has changed; what cannot be kept is said."""
    if memory == kept:
        return kept, code
    try:
        keep_memory(state, memory)
    except OSError as error:
        note("; ".join(lines_of(error)) + ": what was sent is forgotten, and sent again")
        return kept, ExitCode.HARDWARE
    return memory, code


def _try_all(everyone: Sequence[Receiver], site: str, now_utc: datetime) -> ExitCode:
    """Send each receiver a test."""
    when = utc_text(now_utc.replace(microsecond=0))
    words = f"A test, sent at {when}, of whether alarms arrive. Nothing is wrong."
    taken = [_send(receiver, f"dcam {site}: test", words) for receiver in everyone]
    return ExitCode.DONE if all(taken) else ExitCode.HARDWARE


def _send(receiver: Receiver, headline: str, words: str) -> bool:
    try:
        receiver.send(in_zone(headline, shown_zone()), in_zone(words, shown_zone()))
    except NotAcceptedError as error:
        note(f"alarm.{receiver.name} did not accept {headline!r}: {error}")
        return False
    note(f"alarm.{receiver.name} accepted {headline!r}")
    return True
