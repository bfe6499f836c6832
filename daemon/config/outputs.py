"""`[mqtt]`, `[influx]` and `[fleet]`: where rows are sent."""

from __future__ import annotations

from typing import Literal
from urllib.parse import urlsplit

from pydantic import Field

from daemon.config.section import Directory, Section


class MqttSection(Section):
    """`[mqtt]`: a broker, and Home Assistant behind it."""

    host: str | None = Field(default=None, min_length=1)
    port: int | None = Field(default=None, ge=1, le=65_535)
    tls: bool = False
    ca_file: Directory | None = None
    cert_file: Directory | None = None
    key_file: Directory | None = None
    username: str | None = Field(default=None, min_length=1)
    password_file: Directory | None = None
    topic: str | None = Field(default=None, min_length=1)
    qos: Literal[1, 2] = 2
    history: bool = False
    home_assistant: bool = False
    home_assistant_prefix: str = Field(default="homeassistant", min_length=1)

    def problems(self) -> list[str]:
        """Name values that do not go together."""
        found = []
        for key in ("topic", "home_assistant_prefix"):
            name = getattr(self, key)
            if name is not None and (set("+#\0") & set(name) or name[0] in "/$" or name[-1] == "/"):
                found.append(
                    f'mqtt.{key}: "{name}": a topic has no + and #, and neither begins nor ends '
                    "with /"
                )
        if not self.tls and (self.ca_file or self.cert_file or self.key_file):
            found.append("mqtt.tls: must be true for ca_file, cert_file and key_file to be used")
        if (self.cert_file is None) != (self.key_file is None):
            found.append("mqtt.cert_file: needs key_file, and key_file needs cert_file")
        if self.password_file is not None and self.username is None:
            found.append("mqtt.username: missing; password_file holds the password of a user")
        return found


class InfluxSection(Section):
    """`[influx]`: InfluxDB 2 with a bucket; InfluxDB 1 or VictoriaMetrics with a database."""

    url: str | None = Field(default=None, min_length=1)
    org: str | None = Field(default=None, min_length=1)
    bucket: str | None = Field(default=None, min_length=1)
    token_file: Directory | None = None
    database: str | None = Field(default=None, min_length=1)
    username: str | None = Field(default=None, min_length=1)
    password_file: Directory | None = None
    ca_file: Directory | None = None
    measurement: str = Field(default="dcam", min_length=1, max_length=100)
    history: bool = True
    batch: int = Field(default=500, ge=1, le=5000)

    def problems(self) -> list[str]:
        """Name values that do not go together."""
        if self.url is None:
            return []
        found = []
        try:
            parts = urlsplit(self.url)
            usable = parts.scheme in {"http", "https"} and bool(parts.hostname) and not parts.query
        except ValueError:
            return ["influx.url: is no address such as http://127.0.0.1:8086"]
        if not usable:
            found.append("influx.url: must be an address such as http://127.0.0.1:8086")
        if parts.username is not None or parts.password is not None:
            found.append("influx.url: holds a password; use username and password_file")
        if (self.bucket is None) == (self.database is None):
            found.append(
                "influx.bucket: give bucket (InfluxDB 2) or database (InfluxDB 1), not both"
            )
        if (self.username is None) != (self.password_file is None):
            found.append("influx.username: needs password_file, and password_file needs username")
        return found


class FleetSection(Section):
    """`[fleet]`: the central PostgreSQL of many piers."""

    url: str | None = Field(default=None, min_length=1)
    password_file: Directory | None = None
    silent_min: float = Field(default=30.0, gt=0)
    archive: str | None = Field(default=None, min_length=1)

    def problems(self) -> list[str]:
        """Name values that cannot be used."""
        if self.url is None:
            return []
        try:
            parts = urlsplit(self.url)
            usable = parts.scheme in {"postgresql", "postgres"} and len(parts.path) > 1
        except ValueError:
            usable, parts = False, None
        if not usable or parts is None:
            return ["fleet.url: must be an address such as postgresql://dcam@central.example/dcam"]
        if parts.password is not None:
            return ["fleet.url: holds a password; use password_file"]
        return []
