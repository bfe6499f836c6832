"""Where the simulated head truly is, given to the simulated world of another process.

A Unix socket: whoever connects gets the angles of that instant, as one line of JSON, and is let
go. The world asks when a camera is triggered, so that a frame taken too early shows the move.
"""

from __future__ import annotations

import json
import socket
from contextlib import suppress
from pathlib import Path

from drivers.errors import DeviceError

TIMEOUT_S = 2.0


class AnglesGiver:
    """The head's end: a listening socket that is served between two turns of the head's loop."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        path.unlink(missing_ok=True)
        self._socket.bind(str(path))
        self._socket.listen(8)
        self._socket.setblocking(False)  # noqa: FBT003 - the name of the method says what it is

    def fileno(self) -> int:
        """For `select`: readable means that somebody asks."""
        return self._socket.fileno()

    def answer(self, angles_deg: tuple[float, float]) -> None:
        """Tell one who asks."""
        line = json.dumps({"pan_deg": angles_deg[0], "tilt_deg": angles_deg[1]}) + "\n"
        with suppress(OSError):  # who has gone away needs no answer
            asker, _ = self._socket.accept()
            with asker:
                asker.sendall(line.encode())

    def close(self) -> None:
        """Remove the socket."""
        self._socket.close()
        self._path.unlink(missing_ok=True)


class AnglesAsker:
    """The world's end: call it for the pan and tilt of now, degrees."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __call__(self) -> tuple[float, float]:
        """Ask the head's simulator. Raises DeviceError."""
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as head:
                head.settimeout(TIMEOUT_S)
                head.connect(str(self._path))
                with head.makefile("r") as answer:
                    angles = json.loads(answer.readline())
            return float(angles["pan_deg"]), float(angles["tilt_deg"])
        except (OSError, ValueError, KeyError) as error:
            msg = (
                f"simulated rig: no angles from the simulated head at {self._path} ({error}); "
                f"run dcam-ctl simulate head --angles {self._path}"
            )
            raise DeviceError(msg) from None
