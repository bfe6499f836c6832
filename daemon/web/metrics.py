"""`/metrics`: what `dcam-ctl metrics` writes, for a Prometheus that reads over HTTP."""

from __future__ import annotations

import threading
import time
from datetime import UTC, datetime

from daemon.alarm.armed import all_items
from daemon.status.facts import collect_facts
from daemon.status.verdict import no_verdict
from daemon.web.settings import Settings

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
KEPT_S = 5.0
"""However many read: the site is looked at once in this time."""


class Metrics:
    """The text, kept for a moment."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._lock = threading.Lock()
        self._kept = b""
        self._kept_until_s = 0.0

    def text(self) -> bytes:
        """Give the metrics; of a site that cannot be looked at its level alone."""
        with self._lock:
            if time.monotonic() >= self._kept_until_s:
                self._kept = self._collected()
                self._kept_until_s = time.monotonic() + KEPT_S
            return self._kept

    def _collected(self) -> bytes:
        from daemon.reports.metrics import metrics_text, no_metrics_text  # 2 MB, few sites ask

        site = self._settings.site
        try:
            now_utc = datetime.now(UTC)
            facts = collect_facts(site.config, self._settings.state, now_utc, with_budget=False)
            return metrics_text(facts, all_items(site.config, self._settings.state, facts))
        except Exception as error:  # noqa: BLE001 - whatever hides how the site is must be told
            return no_metrics_text(no_verdict(error))
