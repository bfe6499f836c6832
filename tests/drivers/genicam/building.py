"""Shared libraries of C for the tests, built once for all processes and runs."""

from __future__ import annotations

import hashlib
import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path


def built(source: Path, name: str, options: Sequence[str]) -> Path:
    """Build a library of this name, or find the one built before of the same source and options."""
    digest = hashlib.sha256(source.read_bytes() + "\n".join(options).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"dcam-{source.stem}-{os.getuid()}-{digest}"
    folder.mkdir(mode=0o700, exist_ok=True)
    library = folder / name
    if not library.exists():
        part = folder / f"{os.getpid()}.part"
        warnings = ["-Wall", "-Wextra", "-Werror"]
        command = ["gcc", "-O1", *warnings, "-shared", "-fPIC", source, "-o", part, *options]
        subprocess.run(command, check=True)
        part.replace(library)  # whoever builds it at the same time builds the same
    return library
