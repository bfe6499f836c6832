"""Results of blocks of a study, kept as JSON files, so that a second run continues."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
SOURCES = ("core", "drivers")
"""Code that every result depends on."""


class Keep:
    """A directory with one file for each block that has been computed.

    A result is used again only for the same parameters and the same code.
    """

    def __init__(self, directory: Path, modules: tuple[str, ...]) -> None:
        """Modules are files or folders that compute the study, besides SOURCES."""
        self.directory = directory
        self._code = _digest_of_code((*SOURCES, *modules))

    def block(self, name: str, parameters: Mapping[str, Any], compute: Callable[[], Any]) -> Any:
        """Give what was kept under this name, or compute it; the result is plain JSON."""
        path = self.directory / f"{name}.json"
        made_of = {"code": self._code, "parameters": json.loads(json.dumps(dict(parameters)))}
        if path.is_file():
            kept = json.loads(path.read_text(encoding="utf-8"))
            if kept["made_of"] == made_of:
                return kept["result"]
        result = compute()
        self.directory.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.write_text(json.dumps({"made_of": made_of, "result": result}), encoding="utf-8")
        part.replace(path)  # a file is whole or not there
        return json.loads(json.dumps(result))


def _digest_of_code(names: tuple[str, ...]) -> str:
    digest = hashlib.sha256()
    for name in names:
        path = ROOT / name
        for file in [path] if path.is_file() else sorted(path.rglob("*.py")):
            digest.update(str(file.relative_to(ROOT)).encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()
