"""Who would be notified when something is wrong, and whether they can be reached at all."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from pathlib import Path

from core.analysis.alarm_rules import CYCLE_FROM_S, LEAST_ROWS
from daemon.alarm.armed import about
from daemon.alarm.receivers import NotAcceptedError, receiver_problems, receivers
from daemon.checks.finding import Finding, failed
from daemon.config.alarm import AlarmSection, RateAlarm, ReadingAlarm, ValueAlarm
from daemon.errors import ExitCode


def check_alarm(settings: AlarmSection, config: Path, period_s: int) -> Iterator[Finding]:
    """Look at each receiver of `[alarm]`, without sending anything, and at who may read them."""
    yield from _own_alarms(settings, period_s)
    everyone = receivers(settings)
    if not everyone:
        text = "nobody is notified when data stop: name urls or a command in [alarm]"
        yield Finding("alarm", "warning", text)
        return
    try:
        problems = receiver_problems(settings)
    except NotAcceptedError as error:
        yield failed("alarm", error)
        return
    for problem in problems:
        yield Finding("alarm", "error", f"alarm.{problem}", ExitCode.CONFIG)
    if not problems:
        names = ", ".join(receiver.name for receiver in everyone)
        text = f"tells {names} of what is {settings.level} for {settings.after_min:g} min"
        yield Finding("alarm", "ok", f"{text}; dcam-ctl alarm --test sends a message")
    if config.stat().st_mode & stat.S_IROTH:
        text = f"{config} may hold a password, and all may read it"
        cure = f"chown root:dcam {config} && chmod 640 {config}"
        yield Finding("alarm", "warning", f"{text}: {cure}")


def _own_alarms(settings: AlarmSection, period_s: int) -> Iterator[Finding]:
    """Look at each alarm that the site defines."""
    for one in settings.own:
        text = f"{one.name}: {about(one)}, {one.severity}"
        doubt = _doubt(one, period_s)
        if doubt:
            yield Finding("alarm", "warning", f"{text}: {doubt}")
        else:
            yield Finding("alarm", "ok", text)


def _doubt(one: ValueAlarm | RateAlarm | ReadingAlarm, period_s: int) -> str:
    """Say what will surprise of an alarm; empty of one that does as it says."""
    if isinstance(one, RateAlarm):
        if one.window_h < CYCLE_FROM_S / 3600:
            return "the way up or down of a day is a rate in so short a window; give 48 h or more"
        return ""
    if 60 * one.dwell_min < LEAST_ROWS * period_s:
        minutes = LEAST_ROWS * period_s / 60
        return f"{LEAST_ROWS} rows are needed, and take {minutes:g} min; so long it waits"
    return ""
