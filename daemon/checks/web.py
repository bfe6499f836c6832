"""Who could look at the page, and whether its token is one."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from pathlib import Path

from daemon.checks.finding import Finding, failed
from daemon.config.web import WebSection
from daemon.errors import ConfigError


def check_web(settings: WebSection, config: Path) -> Iterator[Finding]:
    """Say where dcam-web listens, and who may read its token."""
    try:
        token = settings.secret()
    except ConfigError as error:
        yield failed("page", error)
        return
    if settings.is_loopback:
        text = f"dcam-web at {settings.host}:{settings.port}, for this machine and SSH tunnels"
    else:
        text = f"dcam-web at {settings.host}:{settings.port}, with the token, as "
        text += ", ".join(settings.hosts)
    yield Finding("page", "ok", text)
    held = settings.token_file or config
    if token is not None and held.stat().st_mode & stat.S_IROTH:
        cure = f"chown root:dcam {held} && chmod 640 {held}"
        yield Finding(
            "page", "warning", f"{held} holds the page's token, and all may read it: {cure}"
        )
