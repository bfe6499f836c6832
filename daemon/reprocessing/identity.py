"""What the last digit of a value hangs on beside images and calibration: versions and processor."""

from __future__ import annotations

import hashlib
import platform
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from llvmlite.binding import get_host_cpu_name

from daemon.version import VERSION

_LIBRARIES = ("numpy", "scipy", "numba", "llvmlite", "opencv-python-headless")
_CODE = ("core", "drivers", "daemon/slots", "daemon/reprocessing")


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
    versions = [
        ("dcam", f"{VERSION} (code {_code_digest()})"),
        ("Python", platform.python_version()),
    ]
    for name in _LIBRARIES:
        try:
            versions.append((name, version(name)))
        except PackageNotFoundError:  # Debian's OpenCV has another name
            versions.append((name, "missing"))
    return Identity(tuple(versions), str(get_host_cpu_name()))


def _code_digest() -> str:
    """A version alone does not tell two checkouts apart."""
    content, root = hashlib.sha256(), Path(__file__).parents[2]
    for package in _CODE:
        for source in sorted((root / package).rglob("*.py")):
            content.update(source.name.encode() + b"\0" + source.read_bytes())
    return content.hexdigest()[:8]
