"""Is the clock disciplined? The kernel knows; a locked-in service asks who disciplines it.

systemd's lock on the clock (ProtectClock) forbids to ask the kernel too: adjtimex(2) both reads and
sets. Then it is timesyncd's own mark, chrony's own word, or systemd-timedated, which may ask the
kernel for anybody.
"""

from __future__ import annotations

import ctypes
import subprocess
import time
from pathlib import Path

_TIME_ERROR = 5
"""What adjtimex(2) answers as long as nothing disciplines the clock; a clock that was set by hand
counts as undisciplined until NTP has confirmed it."""

TIMESYNC_DIRECTORY = Path("/run/systemd/timesync")
"""Of systemd-timesyncd while it runs; it touches `synchronized` there when it sets the clock."""
LAPSE_S = 32_000.0
"""Without an answer for so long the kernel's error estimate passes 16 s, and it says so itself:
500 ppm (adjtimex(2), MAXFREQ and NTP_PHASE_LIMIT in the kernel's timex.h)."""
ANSWER_TIMEOUT_S = 2.0
CHRONY_AGE_S = 5.0
TIMEDATE_AGE_S = 300.0
"""How long an answer is good for; each question starts timedated, and the journal tells of it."""


class Synchronisation:
    """Tells whether something (NTP, PTP) disciplines the clock; None: nobody says."""

    def __init__(
        self, *, ask_kernel: bool = True, timesync_directory: Path = TIMESYNC_DIRECTORY
    ) -> None:
        self._ask_kernel = ask_kernel
        self._timesync_directory = timesync_directory
        self._answer: bool | None = None
        self._good_until_s = -1.0
        """On the monotonic clock of the machine."""

    def __call__(self) -> bool | None:
        """Ask the first who can say."""
        if self._ask_kernel and (answer := kernel_says()) is not None:
            return answer
        if (answer := timesyncd_says(self._timesync_directory)) is not None:
            return answer
        if time.monotonic() >= self._good_until_s:
            self._answer, age_s = chrony_says(), CHRONY_AGE_S
            if self._answer is None:
                self._answer, age_s = timedated_says(), TIMEDATE_AGE_S
            self._good_until_s = time.monotonic() + age_s
        return self._answer


def clock_is_synchronised() -> bool | None:
    """Tell whether something (NTP, PTP) disciplines the clock; None: nobody says."""
    return Synchronisation()()


def kernel_says() -> bool | None:
    """Ask adjtimex(2); None where it may not be asked."""
    try:
        # A zeroed struct timex only reads; 512 bytes are more than it has on any platform.
        answer = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(512))
    except (OSError, AttributeError):
        return None
    return None if answer < 0 else answer != _TIME_ERROR


def timesyncd_says(directory: Path) -> bool | None:
    """Look at timesyncd's mark; None where it does not run."""
    try:
        age_s = time.time() - (directory / "synchronized").stat().st_mtime
    except OSError:
        return False if directory.is_dir() else None
    # A mark of the future was made before the clock was set back.
    return -1.0 <= age_s < LAPSE_S


def chrony_says() -> bool | None:
    """Ask chronyd; None where it is not there or does not answer."""
    answer = _first_line("chronyc", "-c", "tracking")
    return None if answer is None else answer.rpartition(",")[2] != "Not synchronised"


def timedated_says() -> bool | None:
    """Ask timedated, over the system's bus; None where it is not there."""
    answer = _first_line("timedatectl", "show", "--property=NTPSynchronized", "--value")
    return {"yes": True, "no": False}.get(answer or "")


def _first_line(*command: str) -> str | None:
    try:
        done = subprocess.run(  # noqa: S603 - fixed words, no shell
            command, capture_output=True, text=True, check=True, timeout=ANSWER_TIMEOUT_S
        )
    except (OSError, subprocess.SubprocessError):
        return None
    lines = done.stdout.splitlines()
    return lines[0].strip() if lines else None
