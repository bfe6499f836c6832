"""Which modules a command loads: what users and monitoring systems wait for at every start."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.waiting import PATIENCE_S

_PROGRAM = """
import sys
from daemon import ctl
code = ctl.run(ctl.cli, "dcam-ctl")
print(*sys.modules, file=sys.stderr)
sys.exit(code)
"""


def modules_of(*words: object, code: int = 0) -> set[str]:
    """Run `dcam-ctl` in a process of its own; the full names of all modules it has loaded."""
    ran = subprocess.run(
        [sys.executable, "-c", _PROGRAM, *map(str, words)],
        cwd=Path(__file__).parents[3],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert ran.returncode == code, ran.stdout + ran.stderr
    return set(ran.stderr.split())
