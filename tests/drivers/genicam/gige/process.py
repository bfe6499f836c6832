"""Start, command, kill and restart a camera that is a process, as `gige.server`."""

from __future__ import annotations

import queue
import signal
import threading
from collections.abc import Sequence
from pathlib import Path
from subprocess import PIPE
from typing import ClassVar, Self

from tests.programs import Program
from tests.waiting import PATIENCE_S

REPOSITORY = Path(__file__).resolve().parents[4]


class CameraProcess:
    """One camera in a process of its own."""

    module: ClassVar[str] = "tests.drivers.genicam.gige.server"
    place: ClassVar[str] = "--address"
    """Its option that says where it is found."""

    def __init__(
        self, address: str, serial: str, images: Sequence[Path], options: Sequence[str] = ()
    ) -> None:
        self.address = address
        self.serial = serial
        self._arguments = [self.place, address, "--serial", serial, *options, *map(str, images)]
        self._process: Program | None = None
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._reader: threading.Thread | None = None
        self._sent = threading.Condition()
        self._wires: dict[str, tuple[CameraProcess, int]] = {}
        self.frames: list[str] = []
        """Names of the images sent, over all restarts."""

    def start(self) -> Self:
        """Start and wait until the camera answers."""
        self._process = Program(self.module, *self._arguments, stdin=PIPE, stdout=PIPE)
        self._reader = threading.Thread(target=self._read, args=(self._process,), daemon=True)
        self._reader.start()
        self._expect("ready")
        return self

    def command(self, line: str) -> None:
        """Give the camera an order and wait until it obeys."""
        self.send(line)
        self._expect(f"done {line.split(maxsplit=1)[0]}")

    def register(self, address: int) -> int:
        """What stands at an address of the camera: its state, as no driver can colour it."""
        self.send(f"show {address:x}")
        return int(self._lines.get(timeout=PATIENCE_S).removeprefix("register "))

    def wait_for_sent(self, n: int) -> None:
        """Wait until so many frames have been sent, over all restarts."""
        with self._sent:
            assert self._sent.wait_for(lambda: len(self.frames) >= n, PATIENCE_S)

    def wire(self, line: int, other: CameraProcess, other_line: int) -> None:
        """Lay a wire from an output line to a line of another camera."""
        self._wires[str(line)] = (other, other_line)

    def send(self, line: str) -> None:
        """Give an order that is not answered."""
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def freeze(self) -> None:
        """Make it silent."""
        assert self._process is not None
        self._process.send_signal(signal.SIGSTOP)
        self._process.wait_until_stopped()

    def thaw(self) -> None:
        """Let it go on."""
        assert self._process is not None
        self._process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        """As when its cable is pulled."""
        if self._process is None:
            return
        self._process.kill()
        self._process.wait()
        assert self._reader is not None
        self._reader.join()
        for stream in (self._process.stdin, self._process.stdout):
            assert stream is not None
            stream.close()
        self._process = None

    def _read(self, process: Program) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            verb, _, rest = line.strip().partition(" ")
            if verb == "frame":
                with self._sent:
                    self.frames.append(rest.split(" ", 1)[1])
                    self._sent.notify_all()
            elif verb == "line":
                if rest in self._wires:
                    other, line_in = self._wires[rest]
                    other.send(f"edge {line_in}")
            else:
                self._lines.put(line.strip())

    def _expect(self, line: str) -> None:
        answer = self._lines.get(timeout=PATIENCE_S)
        assert answer == line, f"camera {self.serial} says {answer!r} instead of {line!r}"
