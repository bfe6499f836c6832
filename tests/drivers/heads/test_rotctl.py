"""A client that nobody here wrote drives the simulated ASCII unit through its port: `rotctl`.

Hamlib knows such units from 4.6 on (model 2501, rotators/flir). Where its program is not installed,
or is older, the same conversation is held here; which of the two it was is said after the tests.
"""

from __future__ import annotations

import os
import select
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.sim.head_angles import AnglesAsker
from tests.drivers.heads.test_head_programs import simulated_head
from tests.waiting import PATIENCE_S, wait_for

MODEL = "2501"
ARCSEC = 185.14
D46 = ("--protocol", "ptu", "--arcsec-per-count", str(ARCSEC), "--speed-factor", "20")
"""It comes up with its echo on and verbose, as a unit does."""

Client = Callable[..., str]
"""Carries out `P azimuth elevation` or `p`, degrees, level being 90; gives what it prints."""


def rotctl() -> str | None:
    """The program, if it is there and knows these units."""
    program = shutil.which("rotctl")
    if program is None:
        return None
    known = subprocess.run([program, "--list"], capture_output=True, text=True, check=False).stdout
    return program if any(line.split()[:1] == [MODEL] for line in known.splitlines()) else None


def by_program(program: str, port: Path) -> Client:
    def run(*order: str) -> str:
        done = subprocess.run(
            [program, "-m", MODEL, "-r", str(port), *order],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=3 * PATIENCE_S,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def by_conversation(port: Path) -> Client:
    """What the program sends, and how it listens.

    All that was heard before an order is thrown away, and of what comes after it one line is read,
    which must begin with `*`: so one `*` does for both orders of a move.
    """

    def run(*order: str) -> str:
        descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY)
        try:
            ask(descriptor, "ED", answered=False)
            ask(descriptor, "FT")
            for axis in "PT":
                assert float(ask(descriptor, f"{axis}R")) == ARCSEC
            if order[0] == "P":
                pan, tilt = float(order[1]), float(order[2]) - 90.0
                ask(descriptor, f"PP{int(pan * 3600 / ARCSEC)} TP{int(tilt * 3600 / ARCSEC)}")
                return ""
            pan, tilt = (int(ask(descriptor, axis)) * ARCSEC / 3600 for axis in ("PP", "TP"))
            return f"{pan:.2f}\n{tilt + 90.0:.2f}\n"
        finally:
            os.close(descriptor)

    return run


def ask(descriptor: int, order: str, *, answered: bool = True) -> str:
    """Send one line; give what stands behind the `*` of its answer."""
    while select.select([descriptor], [], [], 0.0)[0]:
        os.read(descriptor, 4096)
    os.write(descriptor, f"{order}\n".encode())
    line = b""
    while not line.endswith(b"\r"):
        assert select.select([descriptor], [], [], PATIENCE_S)[0], f"no answer to {order}"
        line += os.read(descriptor, 1)
    assert not answered or line.startswith(b"*"), line
    return line[1:].decode()


def test_rotctl_moves_the_unit_to_5_deg_and_reads_4_99(
    tmp_path: Path, tally: Callable[[str], None]
) -> None:
    """Truncated to 97 counts both ways; tilt is asked for as elevation, 85 for 5 deg down."""
    program, port = rotctl(), tmp_path / "head"
    client = by_program(program, port) if program else by_conversation(port)
    tally(f"simulated pan-tilt unit: driven by {program or 'the conversation of rotctl'}")
    with simulated_head(tmp_path, *D46):
        client("P", "5", "85")
        ask_true = AnglesAsker(tmp_path / "angles")
        wait_for(lambda: ask_true() == pytest.approx((4.98849, -4.98849), abs=1e-4), "the move")
        assert client("p").split() == ["4.99", "85.01"]
