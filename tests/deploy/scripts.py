"""What tests of `make install` and `make deb` share: the scripts of deploy/, without a network."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.exhaustive import IS_ASKED
from tests.shared import shared_directory

ROOT = Path(__file__).parents[2]
OFFLINE = {
    "WHEEL_FLAGS": "--no-build-isolation --no-index",
    "PIP_FLAGS": "--no-deps --no-index",
    "DEB_COMPRESSION": "gzip",
    "MANUAL": "no",
    "COMPILE": "no",
}


def wheel(factory: pytest.TempPathFactory) -> str:
    """Our wheel, built once as build-venv would for each environment."""

    def fill(directory: Path) -> None:
        command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir"]
        flags = OFFLINE["WHEEL_FLAGS"].split()
        subprocess.run([*command, directory, *flags, ROOT], check=True)

    (built,) = shared_directory(factory, "wheel", fill).glob("dcam-*.whl")
    return str(built)


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
    *(f"share/man/man8/{service}.8.gz" for service in ("dcamd", "dcam-web")),
    *(f"share/man/man1/dcam-ctl{part}.1.gz" for part in ("", "-status", "-simulate-site")),
)

THINNED = """#!/bin/sh
"{python}" "$@"
cd "$3"
for text in *.help; do
  case " {pages} " in *" ${{text%.help}} "*) ;; *) rm "$text" ;; esac
done
"""


def man_python(directory: Path) -> str:
    """For MAN_PYTHON: one that writes the texts of MANUAL only, unless every page is asked for.

    The pages are alike, and to make one and look at it takes a tenth of a second.
    """
    if IS_ASKED:
        return sys.executable
    pages = " ".join(Path(page).name.removesuffix(".gz") for page in MANUAL)
    script = directory / "man-python"
    script.write_text(THINNED.format(python=sys.executable, pages=pages))
    script.chmod(0o755)
    return str(script)


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
