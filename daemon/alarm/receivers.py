"""Those who are told: Apprise's addresses, and a program of the site's own."""

from __future__ import annotations

import hashlib
import logging
import os
import signal
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from daemon.config.alarm import AlarmSection
from daemon.errors import HardwareError
from drivers.deadline import DeadlineExceededError, DeadlineThread

DEADLINE_S = 60.0
"""For one receiver to accept one message."""

Send = Callable[[str, str], None]
"""Title, text. Raises NotAcceptedError."""


class NotAcceptedError(HardwareError):
    """A receiver did not take a message."""


@dataclass(frozen=True, slots=True)
class Receiver:
    """One who is told."""

    name: str
    """As the config has it, without its secrets."""
    key: str
    """For the memory: the same as long as the address is the same, and no secret either."""
    send: Send


def receivers(settings: AlarmSection) -> list[Receiver]:
    """All that the config names."""
    found = [
        Receiver(f"urls[{number}] ({url.partition(':')[0]})", _key(url), partial(_notify, url))
        for number, url in enumerate(settings.urls)
    ]
    if settings.command:
        command = settings.command
        found.append(Receiver("command", _key("\0".join(command)), partial(_run, command)))
    return found


def _key(address: str) -> str:
    return hashlib.sha256(address.encode()).hexdigest()[:16]


class _Complaints(logging.Handler):
    """Keeps what Apprise says of a failure: it tells its log, and raises nothing."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(" ".join(record.getMessage().split()))


def _notify(url: str, title: str, text: str) -> None:
    try:
        import apprise
    except ImportError:
        msg = "apprise is not installed; pip install 'dcam[alarm]'"
        raise NotAcceptedError(msg) from None

    def notify() -> bool:
        # Its own threads would gain nothing for one address, and outlive the deadline.
        asset = apprise.AppriseAsset(app_id="dcam", async_mode=False)
        sender = apprise.Apprise(asset=asset)
        if not sender.add(url):
            msg = "not an address that Apprise knows; see its list of URLs"
            raise NotAcceptedError(msg)
        return bool(sender.notify(body=text, title=title, body_format=apprise.NotifyFormat.TEXT))

    log, complaints = logging.getLogger("apprise"), _Complaints()
    log.addHandler(complaints)
    propagate, log.propagate = log.propagate, False
    try:
        accepted = DeadlineThread("dcam-alarm", lambda: None).call(notify, DEADLINE_S)
    except DeadlineExceededError:
        msg = f"no answer in {DEADLINE_S:.0f} s"
        raise NotAcceptedError(msg) from None
    finally:
        log.removeHandler(complaints)
        log.propagate = propagate
    if not accepted:
        raise NotAcceptedError("; ".join(complaints.lines) or "not accepted")


def _run(command: Sequence[str], title: str, text: str) -> None:
    try:
        process = subprocess.Popen(  # noqa: S603 - the program that the site's own config names
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
        )
    except OSError as error:
        msg = f"{command[0]}: {error.strerror}"
        raise NotAcceptedError(msg) from None
    with process:
        try:
            _, complaint = process.communicate(f"{title}\n{text}\n", DEADLINE_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # what it has started, too
            msg = f"{command[0]}: not done in {DEADLINE_S:.0f} s"
            raise NotAcceptedError(msg) from None
    if process.returncode:
        last = (complaint.strip().splitlines() or ["no word"])[-1]
        msg = f"{command[0]}: ended with code {process.returncode}: {last}"
        raise NotAcceptedError(msg)
