"""Passwords and tokens: each in a file of its own, never in the config, a log or a message."""

from __future__ import annotations

from pathlib import Path

from daemon.file_errors import file_error_text
from daemon.outputs.output import NotTakenError

_LONGEST = 10_000


def read_secret(path: Path, key: str) -> str:
    """Give the first line of a file, read whenever it is needed: it may be renewed.

    Raises NotTakenError, which names the key and the file.
    """
    try:
        with path.open(encoding="utf-8") as file:
            secret = file.read(_LONGEST).strip().partition("\n")[0].strip()
    except OSError as error:
        msg = f"{key}: {file_error_text(error)}"
        raise NotTakenError(msg) from error
    except UnicodeDecodeError:
        secret = ""
    if not secret or not secret.isprintable():
        msg = f"{key}: {path}: holds no secret in its first line"
        raise NotTakenError(msg)
    return secret
