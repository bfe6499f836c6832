"""What the history calls the changes of a disk that fills up."""

from __future__ import annotations

NOT_KEPT, KEPT_AGAIN = "frames_not_kept", "frames_kept_again"
RESERVE_GONE, RESERVE_BACK = "reserve_given_up", "reserve_made"
