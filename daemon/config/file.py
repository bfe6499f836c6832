"""Which config and which state directory count; what a file holds, before it is checked."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from daemon.errors import ConfigError
from daemon.file_errors import file_error_text

DEFAULT_CONFIG_PATH = Path("/etc/dcam/dcam.toml")
MOST_BYTES = 1_000_000
"""A hundred times the longest config with all its comments."""


def find_config(flag: Path | None, environ: Mapping[str, str] = os.environ) -> Path:
    """Settle which config counts."""
    return flag or _from_environment(environ, "DCAM_CONFIG") or DEFAULT_CONFIG_PATH


def find_state(
    flag: Path | None, configured: Path, environ: Mapping[str, str] = os.environ
) -> Path:
    """Settle which state directory counts, where the config names this one."""
    return (flag or _from_environment(environ, "DCAM_STATE") or configured).absolute()


def _from_environment(environ: Mapping[str, str], name: str) -> Path | None:
    value = environ.get(name)
    return Path(value) if value else None


def read_toml(path: Path) -> dict[str, Any]:
    """What a file holds. Raises ConfigError."""
    try:
        with path.open("rb") as file:
            content = file.read(MOST_BYTES + 1)
        if len(content) <= MOST_BYTES:
            # Some editors begin a UTF-8 file with a byte order mark.
            return tomllib.loads(content.decode("utf-8-sig"))
        msg = f"{path}: more than {MOST_BYTES // 1000} kB: this is no config of a site"
    except FileNotFoundError:
        msg = f"{path}: no such file; name one with --config FILE or DCAM_CONFIG"
    except OSError as error:
        msg = file_error_text(error)
    except UnicodeDecodeError as error:
        msg = f"{path}: byte {error.start} is not UTF-8; save the file as UTF-8"
    except tomllib.TOMLDecodeError as error:
        msg = f"{path}: not valid TOML: {error}"
    except RecursionError:
        msg = f"{path}: not valid here: tables or lists within one another, hundreds deep"
    raise ConfigError(msg)
