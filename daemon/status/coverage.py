"""Coverage as people read it."""

from __future__ import annotations

from daemon.store.records import Coverage


def coverage_text(coverage: Coverage) -> str:
    """What became of the slots of a span, in one line."""
    share = coverage.measured / coverage.expected if coverage.expected else 0.0
    counts = (
        (coverage.good, "good"),
        (coverage.suspect, "suspect"),
        (coverage.bad, "bad"),
        (coverage.missing, "without images"),
        (coverage.missed, "in gaps"),
        (coverage.unaccounted, "not accounted for yet"),
    )
    parts = ", ".join(f"{count} {what}" for count, what in counts if count)
    return f"{share:.1%} of {coverage.expected} slots measured: {parts}"
