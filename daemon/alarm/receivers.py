"""The receivers of an alarm: Apprise's addresses, and a program of the site's own.

Addresses and commands hold secrets: no message repeats one, it names the position and the scheme.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote

from daemon.config.alarm import AlarmSection
from daemon.errors import HardwareError
from drivers.deadline import DeadlineExceededError, DeadlineThread
from drivers.errors import MissingLibraryError
from drivers.libraries import require_library

DEADLINE_S = 60.0
"""For one receiver to accept one message."""

_SHORTEST = 3
"""Characters of a value that is worth leaving out; shorter ones are in every word."""
_CODE = re.compile(r"\d{3}")
"""An HTTP status, say: it is no secret, and tells why."""

Send = Callable[[str, str], None]
"""Title, text. Raises NotAcceptedError."""


class NotAcceptedError(HardwareError):
    """A receiver did not take a message."""


@dataclass(frozen=True, slots=True)
class Receiver:
    """One who is notified."""

    name: str
    """Its key in the config, with the scheme of an address."""
    key: str
    """For the memory: the same as long as the address is the same, and no secret either."""
    send: Send


def receivers(settings: AlarmSection) -> list[Receiver]:
    """All that the config names."""
    found = [
        Receiver(_name(number, url), _key(url), partial(_notify, url))
        for number, url in enumerate(settings.urls)
    ]
    if settings.command:
        command = settings.command
        found.append(Receiver("command", _key("\0".join(command)), partial(_run, command)))
    return found


def receiver_problems(settings: AlarmSection) -> list[str]:
    """Name the receivers that cannot work, each with what to do; nothing is sent.

    Raises NotAcceptedError where Apprise is not installed.
    """
    problems = [
        f"{_name(number, url)}: Apprise cannot use it; compare it with Apprise's list of URLs"
        for number, url in enumerate(settings.urls)
        if not _instantiates(url)
    ]
    problem = _program_problem(settings.command[0]) if settings.command else None
    return problems if problem is None else [*problems, f"command[0]: {problem}"]


def _name(number: int, url: str) -> str:
    scheme = re.match(r"[A-Za-z][A-Za-z0-9+.-]*(?=:/)", url)
    return f"urls[{number}] ({scheme[0] if scheme else 'no scheme'})"


def _instantiates(url: str) -> bool:
    with _apprise_log():
        return _apprise().Apprise.instantiate(url) is not None


def _program_problem(program: str) -> str | None:
    """Say why a program cannot be started; None if it can."""
    if shutil.which(program) is not None:
        return None
    if "/" not in program:
        return "no such program in PATH; name it by its whole path"
    if not Path(program).is_file():
        return "there is no such program; check its path"
    return "the program is not executable; chmod +x it, for the user dcam too"


def _parts(url: str) -> Iterator[str]:
    """What an address is made of, but for its scheme: each part may be a secret."""
    parts = re.split(r"[/:@?&=,;#]+", url)[1:]
    yield from parts
    yield from map(unquote, parts)


def _words(command: Sequence[str]) -> Iterator[str]:
    """What a command is made of, and what stands behind the `=` of its options."""
    yield from command
    yield from (word.partition("=")[2] for word in command)


def _without_values(said: str, values: Iterable[str]) -> str:
    """Leave out of a complaint what others quote of that which they were called with."""
    telling = {value for value in values if len(value) >= _SHORTEST and not _CODE.fullmatch(value)}
    for value in sorted(telling, key=len, reverse=True):
        said = said.replace(value, "...")
    return said


def _key(address: str) -> str:
    return hashlib.sha256(address.encode()).hexdigest()[:16]


class _Complaints(logging.Handler):
    """Keeps what Apprise says of a failure: it writes to its log, and raises nothing."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(" ".join(record.getMessage().split()))


@contextmanager
def _apprise_log() -> Iterator[_Complaints]:
    """Keep what Apprise logs while the block runs, away from the terminal."""
    log, complaints = logging.getLogger("apprise"), _Complaints()
    log.addHandler(complaints)
    propagate, log.propagate = log.propagate, False
    try:
        yield complaints
    finally:
        log.removeHandler(complaints)
        log.propagate = propagate


def _apprise() -> ModuleType:
    try:
        require_library("apprise", "message")
    except MissingLibraryError as error:
        raise NotAcceptedError(str(error)) from None
    import apprise

    return apprise


def _notify(url: str, title: str, text: str) -> None:
    apprise = _apprise()

    def notify() -> bool:
        # Its own threads would gain nothing for one address, and outlive the deadline.
        asset = apprise.AppriseAsset(app_id="dcam", async_mode=False)
        sender = apprise.Apprise(asset=asset)
        if not sender.add(url):
            msg = "not an address that Apprise knows; see its list of URLs"
            raise NotAcceptedError(msg)
        return bool(sender.notify(body=text, title=title, body_format=apprise.NotifyFormat.TEXT))

    with _apprise_log() as complaints:
        try:
            accepted = DeadlineThread("dcam-alarm", lambda: None).call(notify, DEADLINE_S)
        except DeadlineExceededError:
            msg = f"no answer in {DEADLINE_S:.0f} s"
            raise NotAcceptedError(msg) from None
        except NotAcceptedError:
            raise
        except Exception as error:  # noqa: BLE001 - of a hundred plug-ins, and it may quote an address
            msg = f"Apprise failed: {type(error).__name__}"
            raise NotAcceptedError(msg) from None
    if not accepted:
        said = "; ".join(complaints.lines) or "not accepted"
        raise NotAcceptedError(_without_values(said, _parts(url)))


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
        msg = _program_problem(command[0]) or f"cannot be started: {error.strerror}"
        raise NotAcceptedError(msg) from None
    with process:
        try:
            _, complaint = process.communicate(f"{title}\n{text}\n", DEADLINE_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # what it has started, too
            msg = f"not done in {DEADLINE_S:.0f} s"
            raise NotAcceptedError(msg) from None
    if process.returncode:
        last = (complaint.strip().splitlines() or ["it printed no reason"])[-1]
        said = _without_values(last, _words(command))
        msg = f"ended with code {process.returncode}: {said}"
        raise NotAcceptedError(msg)
