"""Loads what workers have in common in the process that they are forked from, or ends it.

Without a word: whoever started it says in one line what is wrong (`not_started`).
"""

from __future__ import annotations

try:
    import daemon.reprocessing.of_workers  # noqa: F401 - for its sake
except Exception:  # noqa: BLE001 - whatever it is, workers would meet it too
    raise SystemExit(1) from None
