"""Libraries of dcam's extras: whether one is there, and what to do if not."""

from __future__ import annotations

import importlib.util
import re
import sys
from importlib import metadata
from pathlib import Path

from drivers.errors import MissingLibraryError

_NOT_BROUGHT = ("pyarrow", "dask", "fsspec")
"""What neither `make install` nor the package brings, for its size."""


def has_library(module: str) -> bool:
    """Tell whether a module is installed."""
    return importlib.util.find_spec(module) is not None


def require_library(module: str, what: str, package: str | None = None) -> None:
    """Raise MissingLibraryError with `missing_library`'s words, if there are any."""
    if lack := missing_library(module, what, package):
        raise MissingLibraryError(lack)


def missing_library(module: str, what: str, package: str | None = None) -> str:
    """What to do in this installation if a module is missing; nothing if it is there.

    `what` cannot be had without it; `package` is its name for pip, if another.
    """
    if has_library(module):
        return ""
    package = package or module
    return f"no {what}: {package} is not installed; {how_to_install(package)}"


def how_to_install(package: str, *, extra: str | None = None, there: str = "export") -> str:
    """What to do in this installation to have a package, or all that an extra of dcam brings.

    `there`: what is left to do on another computer where this installation cannot have it.
    """
    if _has_own_pip():
        wanted = f"dcam[{extra}]" if extra else _requirement(package)
        return f"{sys.executable} -m pip install '{wanted}'"
    if package in _NOT_BROUGHT:
        return (
            "neither make install nor the package brings it: take a copy of the state (dcam-ctl "
            f"backup) to another computer with a clone of dcam, run make venv there, and {there}"
        )
    return "this installation is not complete: install dcam again (make install, or the package)"


def _has_own_pip() -> bool:
    """Tell whether this environment has a pip: ours in /opt/dcam have none.

    One of Debian does not count: the next upgrade of dcam removes what it installs.
    """
    found = importlib.util.find_spec("pip")
    own = Path(sys.prefix)
    return found is not None and found.origin is not None and own in Path(found.origin).parents


def _requirement(package: str) -> str:
    """The package with the versions that dcam works with, for pip."""
    try:
        declared = metadata.requires("dcam") or []
    except metadata.PackageNotFoundError:
        declared = []
    wanted = (line.split(";")[0].strip() for line in declared)
    return next((one for one in wanted if re.split(r"[^\w.-]", one)[0] == package), package)
