"""The central database of a config."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from daemon.errors import ConfigError
from daemon.outputs.secret import read_secret

if TYPE_CHECKING:
    from daemon.config.outputs import FleetSection
    from daemon.store.central.connecting import Central


def address(settings: FleetSection) -> tuple[str, str | None]:
    """URL and password. Raises ConfigError, NotTakenError."""
    if settings.url is None:
        msg = "no central database: the config has no [fleet] url; see docs/fleet.md"
        raise ConfigError(msg)
    path = settings.password_file
    return settings.url, None if path is None else read_secret(path, "fleet.password_file")


@contextmanager
def opened(settings: FleetSection) -> Iterator[Central]:
    """Open the central database for a block. Raises as `open_central`, ConfigError."""
    from daemon.store.central.connecting import open_central

    central = open_central(*address(settings))
    try:
        yield central
    finally:
        central.close()
