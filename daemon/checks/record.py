"""What is on the disk: the state directory, the database, the calibration."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Literal

from daemon.checks.finding import Finding, failed
from daemon.config.reading import Installation
from daemon.errors import DatabaseMissingError, ExitCode, StoreError
from daemon.store.database import open_store_readonly


def check_state(site: Installation) -> Finding:
    """Whether dcamd could write its state."""
    state = site.state_directory
    there = next(path for path in (state, *state.parents) if path.is_dir())
    if not os.access(there, os.W_OK | os.X_OK):
        text = f"{there} is not writable; chown it to the user that runs dcamd"
        return Finding("state", "error", text, ExitCode.HARDWARE)
    text = str(state) if there == state else f"{state}, made when dcamd or calibrate runs"
    return Finding("state", "ok", text)


def check_database(site: Installation) -> Iterator[Finding]:
    """Whether the database can be read, and what measures by it."""
    try:
        with open_store_readonly(site.state_directory) as store:
            last, active = store.last_slot(), store.active_calibration()
    except DatabaseMissingError:
        yield Finding("database", "warning", "none yet; dcamd or calibrate makes it")
        return
    except StoreError as error:
        yield failed("database", error)
        return
    yield Finding("database", "ok", f"last row {last:%Y-%m-%dT%H:%M:%SZ}" if last else "no rows")
    if active is None:
        text = "none active; run dcam-ctl calibrate, until then rows have no value"
        yield Finding("calibration", "warning", text)
    elif active.config_hash != site.config.config_hash():
        text = f"{active.id}; the config has changed since: calibrate again"
        yield Finding("calibration", "warning", text)
    else:
        state: Literal["ok", "warning"] = "ok" if active.report.passed else "warning"
        yield Finding("calibration", state, f"{active.id}: {active.report.lines[0]}")
