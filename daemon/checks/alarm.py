"""Who would be notified when something is wrong, and whether they can be reached at all."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from pathlib import Path

from daemon.alarm.receivers import NotAcceptedError, receiver_problems, receivers
from daemon.checks.finding import Finding, failed
from daemon.config.alarm import AlarmSection
from daemon.errors import ExitCode


def check_alarm(settings: AlarmSection, config: Path) -> Iterator[Finding]:
    """Look at each receiver of `[alarm]`, without sending anything, and at who may read them."""
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
