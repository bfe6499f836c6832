"""`[web]`: where dcam-web listens, and who may look."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Annotated

from pydantic import Field, Strict

from daemon.config.section import Directory, Section
from daemon.errors import ConfigError
from daemon.file_errors import file_error_text

LEAST_TOKEN = 16
"""Characters: of random letters and digits more than anyone can try."""
_MOST_TOKEN_BYTES = 4096

Names = Annotated[
    tuple[Annotated[str, Field(pattern=r"^[A-Za-z0-9.:\[\]-]{1,253}$")], ...], Strict(strict=False)
]


class WebSection(Section):
    """`[web]`: loopback needs nothing; to listen wider needs a token and the names it goes by."""

    host: str = "127.0.0.1"
    port: int = Field(default=8766, ge=1, le=65_535)
    token: str | None = Field(default=None, max_length=512)
    token_file: Directory | None = None
    hosts: Names = ()
    language: str = Field(default="en", pattern=r"^[a-z]{2}(-[A-Z]{2})?$")

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach it."""
        return self.host == "localhost" or ipaddress.ip_address(self.host).is_loopback

    def secret(self) -> str | None:
        """The token, from wherever it is. Raises ConfigError for a file that holds none."""
        return self.token if self.token_file is None else _token_of(self.token_file)


def _token_of(path: Path) -> str:
    try:
        with path.open("rb") as file:
            token = file.read(_MOST_TOKEN_BYTES).decode("ascii").strip()
    except OSError as error:
        msg = f"web.token_file: {file_error_text(error)}"
        raise ConfigError(msg) from None
    except UnicodeDecodeError:
        token = ""
    if len(token) < LEAST_TOKEN:
        msg = (
            f"web.token_file: {path} holds no token of at least {LEAST_TOKEN} characters: "
            f"openssl rand -hex 16 > {path}"
        )
        raise ConfigError(msg)
    return token


def web_problems(web: WebSection) -> list[str]:
    """Name what contradicts itself in `[web]`."""
    try:
        is_loopback = web.is_loopback
    except ValueError:
        problem = f'web.host: "{web.host}" is no address; write "127.0.0.1", or "0.0.0.0" for all'
        return [f"{problem} networks"]
    problems = []
    if web.token is not None and web.token_file is not None:
        problems.append("web.token: give it here or in token_file, not in both")
    if web.token is not None and len(web.token) < LEAST_TOKEN:
        problems.append(
            f"web.token: must have at least {LEAST_TOKEN} characters: openssl rand -hex 16"
        )
    if not is_loopback and web.token is None and web.token_file is None:
        problems.append(
            f'web.token: missing; whoever reaches {web.host} could look: "openssl rand -hex 16" '
            'makes one, or leave host = "127.0.0.1" and use an SSH tunnel'
        )
    if not is_loopback and not web.hosts:
        problems.append(
            "web.hosts: missing; list the names or addresses by which browsers ask for this page, "
            'as ["pier-3.example.org", "192.168.1.20"]'
        )
    return problems
