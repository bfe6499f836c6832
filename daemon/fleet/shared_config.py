"""What of a pier's config the central database gets: what its record is read with, no addresses."""

from __future__ import annotations

from typing import Any

from daemon.config.model import Config

_KEPT_HERE = ("alarm", "mqtt", "influx", "fleet", "web", "log", "report", "storage")
"""Tables that may hold addresses with passwords, or are of this computer only."""


def shared_config(config: Config) -> str:
    """The config as TOML without what is nobody else's."""
    import tomlkit

    document: Any = tomlkit.parse(config.path.read_text(encoding="utf-8-sig"))
    for name in _KEPT_HERE:
        document.pop(name, None)
    text: str = tomlkit.dumps(document)
    return text
