"""Who would be notified when something is wrong, and whether they can be reached at all."""

from __future__ import annotations

from collections.abc import Iterator

from daemon.alarm.receivers import NotAcceptedError, receiver_problems, receivers
from daemon.checks.finding import Finding, failed
from daemon.config.alarm import AlarmSection
from daemon.errors import ExitCode


def check_alarm(settings: AlarmSection) -> Iterator[Finding]:
    """Look at each receiver of `[alarm]`, without sending anything."""
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
