"""Rows to InfluxDB over HTTP: `/api/v2/write`, or `/write` of version 1 and VictoriaMetrics.

A request that was stored but not answered is sent again; the points replace themselves.
"""

from __future__ import annotations

import gzip
from collections.abc import Sequence
from urllib.parse import urlencode

from daemon.config.outputs import InfluxSection
from daemon.outputs.certificates import certificate_refused, missing_file
from daemon.outputs.line_protocol import lines_of_row
from daemon.outputs.output import NotTakenError
from daemon.outputs.secret import read_secret
from daemon.store.queries.arrivals import Arrival
from daemon.text import visible
from drivers.libraries import require_library

CONNECT_S, ANSWER_S = 10.0, 30.0
"""How long to wait for a connection, and for each part of the answer."""
_MOST_OF_AN_ANSWER = 300
_TOO_OLD = "beyond retention policy"
"""What the server says of points that its owner does not want to keep: it has taken the others."""


class InfluxOutput:
    """A bucket, or a database."""

    name = "influx"

    def __init__(self, settings: InfluxSection, site: str) -> None:
        """Raises MissingLibraryError."""
        require_library("urllib3", "InfluxDB")
        import urllib3

        self.history, self.batch = settings.history, settings.batch
        self._settings, self._site = settings, site
        self._pool = urllib3.PoolManager(
            timeout=urllib3.Timeout(connect=CONNECT_S, read=ANSWER_S),
            retries=False,
            ca_certs=None if settings.ca_file is None else str(settings.ca_file),
        )

    def send(self, rows: Sequence[Arrival], latest: Arrival | None) -> None:
        """Write points; all of them or none are acknowledged. Raises NotTakenError."""
        del latest
        if not rows:
            return
        import urllib3

        if missing := missing_file({"influx.ca_file": self._settings.ca_file}):
            raise NotTakenError(missing)
        measurement = self._settings.measurement
        lines = [line for row in rows for line in lines_of_row(row, measurement, self._site)]
        body = gzip.compress("\n".join([*lines, ""]).encode(), compresslevel=1)
        try:
            answer = self._pool.request("POST", self._address(), body=body, headers=self._headers())
        except (urllib3.exceptions.HTTPError, OSError) as error:
            why = certificate_refused(error, "influx.ca_file") or _reason(error)
            msg = f"influx.url: {self._settings.url}: {why}"
            raise NotTakenError(msg) from error
        text = visible(answer.data[:_MOST_OF_AN_ANSWER].decode(errors="replace")).strip()
        taken = answer.status in {200, 204} or (answer.status in {400, 422} and _TOO_OLD in text)
        if not taken:
            msg = f"influx.url: {self._settings.url}: HTTP {answer.status}: {text}"
            raise NotTakenError(msg)

    def close(self) -> None:
        """Close the connections."""
        self._pool.clear()

    def _address(self) -> str:
        settings = self._settings
        base = settings.url.rstrip("/") if settings.url else ""
        if settings.database is not None:
            return f"{base}/write?" + urlencode({"db": settings.database, "precision": "s"})
        where = {"org": settings.org or "", "bucket": settings.bucket or "", "precision": "s"}
        return f"{base}/api/v2/write?" + urlencode(where)

    def _headers(self) -> dict[str, str]:
        import urllib3

        settings = self._settings
        headers = {"Content-Type": "text/plain; charset=utf-8", "Content-Encoding": "gzip"}
        if settings.token_file is not None:
            token = read_secret(settings.token_file, "influx.token_file")
            headers["Authorization"] = f"Token {token}"
        elif settings.username is not None and settings.password_file is not None:
            password = read_secret(settings.password_file, "influx.password_file")
            named = f"{settings.username}:{password}"
            headers |= urllib3.make_headers(basic_auth=named)
        return headers


def _reason(error: BaseException) -> str:
    """What urllib3 says, without the objects that it names: the innermost cause."""
    inner = getattr(error, "reason", None) or error.__cause__ or error
    text = str(inner)
    return " ".join(text.rpartition(": ")[2].split()) or type(inner).__name__
