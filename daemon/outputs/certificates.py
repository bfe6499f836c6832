"""A server whose certificate is refused, in words."""

from __future__ import annotations

import ssl
from collections.abc import Mapping
from pathlib import Path


def certificate_refused(error: BaseException, key: str) -> str | None:
    """What is wrong with a server's certificate, if an error or its cause says that; else None.

    `key` names who must have signed it.
    """
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, ssl.SSLCertVerificationError):
            why = cause.verify_message.rstrip(".")
            return f"the server's certificate is refused: {why}; {key} names who must sign it"
        cause = cause.__cause__ or cause.__context__
    return None


def missing_file(files: Mapping[str, Path | None]) -> str | None:
    """Which of the files, by their keys in the config, is none; None if all are there."""
    for key, path in files.items():
        if path is not None and not path.is_file():
            return f"{key}: {path}: no such file"
    return None
