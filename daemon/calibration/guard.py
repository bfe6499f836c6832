"""A second process that halts the head when the one that moves it is killed.

A program that gets SIGKILL, or whose memory is gone, can halt nothing any more, and a head that is
moved by time would turn on to its stop. The guard reads a pipe whose other end only the guarded
program has: when that closes without a word, it opens the port and sends the halt.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from daemon.config.reading import Config, load_config
from daemon.devices import open_head
from daemon.errors import HardwareError
from drivers.errors import DriverError

ALL_WELL, READY = b"all well\n", b"ready\n"
LEAVE_TIMEOUT_S = 20.0


@contextmanager
def guarded_head(config: Config) -> Iterator[None]:
    """Have the head at the config's port halted if this process dies within the block.

    Nothing is needed for a simulated head in this process: it dies with it. Raises HardwareError.
    """
    if not config.pan_tilt.is_serial:
        yield
        return
    with subprocess.Popen(  # noqa: S603 - our own program, no shell
        [sys.executable, "-m", "daemon.calibration.guard", str(config.path.absolute())],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,  # Ctrl-C is for the program that it guards
    ) as guard:
        assert guard.stdin is not None  # noqa: S101 - as asked for above
        assert guard.stdout is not None  # noqa: S101
        if guard.stdout.readline() != READY:
            msg = "the process that guards the head did not start; see its error above"
            raise HardwareError(msg)
        try:
            yield
        finally:
            guard.communicate(ALL_WELL, timeout=LEAVE_TIMEOUT_S)


def stand_by(config_path: Path) -> None:
    """Wait for the guarded program's word, or its end; halt the head at the latter."""
    config = load_config(config_path)
    sys.stdout.buffer.write(READY)
    sys.stdout.buffer.flush()
    if sys.stdin.buffer.readline() == ALL_WELL:
        return
    with closing(open_head(config)) as head:
        head.halt()
    print("dcam-ctl: the head was halted, its program is gone", file=sys.stderr)


if __name__ == "__main__":
    try:
        stand_by(Path(sys.argv[1]))
    except DriverError as error:
        sys.exit(f"dcam-ctl: error: {error}")
