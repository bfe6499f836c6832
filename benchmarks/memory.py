"""Whether a running `dcamd` keeps its memory flat: the real daemon on a small simulated rig."""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

CONFIG = Path(__file__).with_name("small.toml")
SETTLED_AT = 100
"""By then every cache and buffer has been filled once."""


@dataclass(frozen=True, slots=True)
class MemoryUse:
    """Resident memory of `dcamd` over its slots."""

    slots: int
    settled_mb: float
    """After SETTLED_AT slots."""
    end_mb: float
    seconds: float
    """Wall clock, all slots, the rendering of their images included."""

    @property
    def growth_kb_per_slot(self) -> float:
        """Growth from SETTLED_AT to the end."""
        return (self.end_mb - self.settled_mb) * 1024.0 / (self.slots - SETTLED_AT)


def measure_memory(slots: int) -> MemoryUse:
    """Calibrate the small rig, run `dcamd` over some slots, and watch its memory."""
    with tempfile.TemporaryDirectory(prefix="dcam-bench-") as state:
        site = ["--config", str(CONFIG), "--state", state]
        calibrate = ["-m", "daemon.ctl", *site, "calibrate", "--pan-tilt", "--accept"]
        subprocess.run([sys.executable, *calibrate], check=True, capture_output=True)
        return _watch([sys.executable, "-m", "daemon.main", *site, "--max-slots", str(slots)])


def _watch(command: list[str]) -> MemoryUse:
    done, memory_mb = 0, {}
    started_s = time.monotonic()
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as daemon:
        for line in daemon.stderr or ():
            if "slot_done" in line:
                done += 1
                memory_mb[done] = resident_mb(daemon.pid)
    if daemon.returncode != 0 or done <= SETTLED_AT:
        msg = f"dcamd ended with {daemon.returncode} after {done} slots"
        raise RuntimeError(msg)
    # The very last reading may fall on a process that is closing down.
    seconds = time.monotonic() - started_s
    return MemoryUse(done, memory_mb[SETTLED_AT], memory_mb[done - 1], seconds)


def resident_mb(pid: int) -> float:
    """Resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    found = re.search(r"VmRSS:\s+(\d+) kB", status)
    return int(found[1]) / 1024.0 if found else 0.0
