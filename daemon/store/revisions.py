"""Which revisions of the tables there are, without loading Alembic; what to do about another."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import migrations
from daemon.errors import (
    DatabaseForeignError,
    DatabaseNewerError,
    DatabaseOlderError,
    StoreError,
)

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


@dataclass(frozen=True, slots=True)
class Advice:
    """What to say of tables of another version, by where they are."""

    word: str
    """For one state of the tables."""
    foreign: Callable[[object], StoreError]
    """The error of a database without tables of this program."""
    upgrade: str
    """What brings older tables up to date."""
    newer: Callable[[object, Sequence[str]], str]
    """What to do where this version is the older one, given the place and the known revisions."""


def require_head(
    found: str | None,
    place: object,
    known: Sequence[str] = REVISIONS,
    advice: Advice | None = None,
) -> None:
    """Raise DatabaseNewerError or DatabaseOlderError unless the revision is this version's.

    `place` is a site's database file, unless there is other advice. Raises the advice's error where
    this program never made any table.
    """
    said = advice or AT_PIER
    if found is None:
        raise said.foreign(place)
    require_known(found, place, known, said)
    if found != known[-1]:
        msg = (
            f"{place}: written by an older version ({said.word} {found}, this one needs "
            f"{known[-1]}): {said.upgrade}"
        )
        raise DatabaseOlderError(msg)


def require_known(
    found: str | None,
    place: object,
    known: Sequence[str] = REVISIONS,
    advice: Advice | None = None,
) -> None:
    """Raise DatabaseNewerError for a revision that this version does not know."""
    said = advice or AT_PIER
    if found is not None and found not in known:
        msg = (
            f"{place}: written by a newer version ({said.word} {found}, this one knows up to "
            f"{known[-1]}): {said.newer(place, known)}"
        )
        raise DatabaseNewerError(msg)


def _foreign_file(place: object) -> StoreError:
    msg = f"{place}: a SQLite database, but not one of this program: name another --state"
    return DatabaseForeignError(msg)


def _restore(place: object, known: Sequence[str]) -> str:
    backup = _backup_for(Path(str(place)), known)
    restore = (
        f"restore {backup}, which has no later rows" if backup else "restore a backup of before"
    )
    return f"install that version again, or {restore}"


AT_PIER = Advice(
    "revision", _foreign_file, "start dcamd once, it migrates after a backup", _restore
)
"""Of a site's own database file."""


def _backup_for(path: Path, known: Sequence[str]) -> str | None:
    """The newest of the backups made before migrations that this version can read."""
    name = re.compile(rf"{re.escape(path.name)}\.revision-(.+)\.(\d{{8}}T\d{{6}}Z(?:\.\d+)?)")
    found = (match for file in path.parent.iterdir() if (match := name.fullmatch(file.name)))
    usable = [(match[2], match[0]) for match in found if match[1] in known]
    return max(usable)[1] if usable else None
