"""A dcamd that is killed while it measures rows again: a program, `CONFIG STATE ROWS`."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

from daemon.config.reading import find_installation
from daemon.main import serve
from daemon.store.database import Store
from daemon.store.records import MeasurementRecord

_measured_again = Store.measured_again


def main(config: Path, state: Path, rows: int) -> None:
    """Run a slot; the process is killed once so many rows were measured again."""
    left = rows

    def measured_again(store: Store, number: int, record: MeasurementRecord) -> None:
        nonlocal left
        _measured_again(store, number, record)
        left -= 1
        if not left:
            os.kill(os.getpid(), signal.SIGKILL)

    Store.measured_again = measured_again  # type: ignore[method-assign]
    serve(find_installation(config, state), max_slots=1)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
