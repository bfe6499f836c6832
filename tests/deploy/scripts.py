"""What tests of `make install` and `make deb` share: the scripts of deploy/, without a network."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
OFFLINE = {
    "WHEEL_FLAGS": "--no-build-isolation --no-index",
    "PIP_FLAGS": "--no-deps --no-index",
    "DEB_COMPRESSION": "gzip",
    "MANUAL": "no",
    "COMPILE": "no",
}


def deploy(script: str, *arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(ROOT / "deploy" / script), *(str(argument) for argument in arguments)],
        env={**os.environ, "PYTHON": sys.executable, **OFFLINE, **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def install(tree: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return deploy("install", sys.executable, DESTDIR=str(tree), **environment)


MANUAL = (
    "share/man/man5/dcam.toml.5.gz",
    "share/man/man8/dcamd.8.gz",
    *(f"share/man/man1/dcam-ctl{part}.1.gz" for part in ("", "-status", "-simulate-site")),
)


def documents_of_units(tree: Path, units: str) -> list[Path]:
    """Where in the tree each file lies that `systemctl help` would show."""
    named = [
        word.removeprefix("file:///")
        for unit in (tree / units).glob("*.*")
        for line in unit.read_text().splitlines()
        if line.startswith("Documentation=")
        for word in line.removeprefix("Documentation=").split()
        if word.startswith("file:///")
    ]
    return [tree / name for name in named]
