"""Which revisions of the tables there are, without loading Alembic; what to do about another."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import migrations
from daemon.errors import DatabaseForeignError, DatabaseNewerError, DatabaseOlderError

SCRIPTS = Path(str(migrations.__file__)).parent
"""Installed beside this program."""

_SCRIPT = re.compile(r"(\d{4})_\w+\.py")


def known_revisions(scripts: Path = SCRIPTS) -> tuple[str, ...]:
    """The revisions in the order in which they are applied, as the scripts' names say."""
    found = (_SCRIPT.fullmatch(script.name) for script in (scripts / "versions").iterdir())
    known = tuple(sorted(name[1] for name in found if name))
    if not known:
        msg = "no migrations are installed: install the program again"
        raise RuntimeError(msg)
    return known


REVISIONS = known_revisions()
"""The last is this version's."""


def require_head(found: str | None, path: Path, known: Sequence[str] = REVISIONS) -> None:
    """Raise DatabaseNewerError or DatabaseOlderError unless the revision is this version's.

    Raises DatabaseForeignError where this program never made any table.
    """
    if found is None:
        msg = f"{path}: a SQLite database, but not one of this program: name another --state"
        raise DatabaseForeignError(msg)
    require_known(found, path, known)
    if found != known[-1]:
        msg = (
            f"{path}: written by an older version (revision {found}, this one needs "
            f"{known[-1]}): start dcamd once, it migrates after a backup"
        )
        raise DatabaseOlderError(msg)


def require_known(found: str | None, path: Path, known: Sequence[str] = REVISIONS) -> None:
    """Raise DatabaseNewerError for a revision that this version does not know."""
    if found is not None and found not in known:
        backup = _backup_for(path, known)
        restore = (
            f"restore {backup}, which has no later rows" if backup else "restore a backup of before"
        )
        msg = (
            f"{path}: written by a newer version (revision {found}, this one knows up to "
            f"{known[-1]}): install that version again, or {restore}"
        )
        raise DatabaseNewerError(msg)


def _backup_for(path: Path, known: Sequence[str]) -> str | None:
    """The newest of the backups made before migrations that this version can read."""
    name = re.compile(rf"{re.escape(path.name)}\.revision-(.+)\.(\d{{8}}T\d{{6}}Z(?:\.\d+)?)")
    found = (match for file in path.parent.iterdir() if (match := name.fullmatch(file.name)))
    usable = [(match[2], match[0]) for match in found if match[1] in known]
    return max(usable)[1] if usable else None
