"""What the last digit of a value depends on beside images, config and calibration.

Code, libraries and processor. A version alone does not tell two checkouts apart, nor two versions
of a library.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import llvmlite
import numba
import numpy as np
import scipy
from llvmlite.binding import get_host_cpu_name

from daemon.version import VERSION

ROOT = Path(__file__).parents[2]
NUMERICS = (
    "core",
    "daemon/slots/learner.py",
    "daemon/slots/measuring.py",
    "daemon/slots/row_history.py",
)
"""What makes the values of a row from its images and the rows before it."""
_WORKERS = ("core", "drivers", "daemon/slots", "daemon/reprocessing")
"""What workers of one run must have alike: they pass our objects to each other."""
_DIGITS = 8


@dataclass(frozen=True, slots=True)
class Identity:
    """What a process computes with."""

    versions: tuple[tuple[str, str], ...]
    """Name and version; the first is dcam's, with a digest of its code."""
    processor: str

    def differences(self, other: Identity) -> str:
        """Name what is of another version there; empty where nothing is."""
        theirs = dict(other.versions)
        return ", ".join(
            f"{name} {theirs.get(name, 'missing')} there, {own} here"
            for name, own in self.versions
            if theirs.get(name) != own
        )


@cache
def own_identity() -> Identity:
    """Of this process."""
    own = ("dcam", f"{VERSION} (code {code_digest(_WORKERS)})")
    return Identity((own, *_libraries()), str(get_host_cpu_name()))


@cache
def made_by() -> str:
    """The version as rows and calibrations keep it: `0.1.0+` and a digest of the numerics.

    Equal texts mean equal code, libraries and type of processor.
    """
    computed_with = (_numerics_digest(), _libraries(), str(get_host_cpu_name()))
    return f"{VERSION}+{hashlib.sha256(repr(computed_with).encode()).hexdigest()[:_DIGITS]}"


def made_with() -> str:
    """What the digest of `made_by` was made of, in words."""
    named = ", ".join(f"{name} {version}" for name, version in _libraries())
    return f"code {_numerics_digest()}, {named}, processor {get_host_cpu_name()}"


@cache
def _numerics_digest() -> str:
    return code_digest(NUMERICS)


def _libraries() -> tuple[tuple[str, str], ...]:
    return (
        ("Python", platform.python_version()),
        ("numpy", np.__version__),
        ("scipy", scipy.__version__),
        ("numba", numba.__version__),
        ("llvmlite", llvmlite.__version__),
        ("opencv", cv2.__version__),
    )


def code_digest(names: Iterable[str], root: Path = ROOT) -> str:
    """SHA-256 of modules and folders of them, shortened."""
    content = hashlib.sha256()
    for name in names:
        place = root / name
        for source in [place] if place.is_file() else sorted(place.rglob("*.py")):
            content.update(str(source.relative_to(root)).encode() + b"\0" + source.read_bytes())
    return content.hexdigest()[:_DIGITS]
