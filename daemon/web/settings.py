"""What the page needs to know of where it is."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from daemon.config.reading import Installation
from daemon.config.web import WebSection
from daemon.errors import HardwareError
from daemon.file_errors import file_error_text

LOOPBACK_NAMES = frozenset({"localhost", "127.0.0.1", "[::1]"})


@dataclass(frozen=True, slots=True)
class Viewers:
    """Who may look."""

    token: str | None = field(default=None, repr=False)
    hosts: frozenset[str] = LOOPBACK_NAMES
    """Names that a browser may ask for, without the port, in small letters."""


@dataclass(frozen=True, slots=True)
class Settings:
    """A site, and who may look at its page."""

    site: Installation
    cache: Path
    """A directory of the page's own; it may be removed at any time."""
    viewers: Viewers = Viewers()

    @property
    def state(self) -> Path:
        """Database and frames."""
        return self.site.state_directory


def settings_of(site: Installation) -> Settings:
    """What `[web]` says. Raises ConfigError, HardwareError."""
    return Settings(site, cache_directory(site.state_directory), viewers(site.config.web))


def viewers(web: WebSection) -> Viewers:
    """Who may look, as `[web]` says. Raises ConfigError."""
    names = {name.lower() for name in web.hosts}
    plain = {f"[{name}]" if name.count(":") > 1 and "[" not in name else name for name in names}
    hosts = frozenset(plain) if plain else LOOPBACK_NAMES
    if web.is_loopback:
        hosts |= LOOPBACK_NAMES
    return Viewers(web.secret(), hosts)


def cache_directory(state: Path, environ: Mapping[str, str] = os.environ) -> Path:
    """Where the page may keep what it works out: systemd's word, or the user's own cache.

    Raises HardwareError.
    """
    given = environ.get("CACHE_DIRECTORY")
    if given:
        return Path(given.split(":")[0])
    name = hashlib.sha256(str(state).encode()).hexdigest()[:16]
    home = environ.get("XDG_CACHE_HOME") or str(Path("~/.cache").expanduser())
    directory = Path(home) / "dcam-web" / name
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError:
        return _temporary(name)
    return directory if os.access(directory, os.W_OK) else _temporary(name)


def _temporary(name: str) -> Path:
    """A directory of this user's below /tmp, which nobody else may write to."""
    directory = Path(tempfile.gettempdir()) / f"dcam-web-{os.getuid()}-{name}"
    try:
        directory.mkdir(mode=0o700, exist_ok=True)
        found = directory.lstat()
    except OSError as error:
        raise HardwareError(file_error_text(error)) from error
    if found.st_uid != os.getuid() or found.st_mode & 0o022:
        msg = f"{directory}: somebody else's: remove it, or set XDG_CACHE_HOME"
        raise HardwareError(msg)
    return directory
