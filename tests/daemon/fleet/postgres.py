"""A PostgreSQL server of one's own, and a line to it that can be cut."""

from __future__ import annotations

import itertools
import os
import pwd
import random
import shutil
import socket
import subprocess
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

_USER = "nobody"
"""Runs the server where the tests are root: PostgreSQL refuses to be."""


def programs() -> Path | None:
    """The directory of Debian's newest server programs."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda p: int(p.parts[4]))
    return found[-1].parent if found else None


def free_port() -> int:
    """A port that nobody has at the moment."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


class Server:
    """A server on a free port of loopback, its data in a directory that goes with it."""

    def __init__(self, *settings: str) -> None:
        found = programs()
        assert found is not None, "no PostgreSQL: apt-get install postgresql-15"
        self._programs, self._settings = found, settings
        self.port = free_port()
        self.directory = Path(tempfile.mkdtemp(prefix="dcam-postgres-"))
        if os.getuid() == 0:
            owner = pwd.getpwnam(_USER)
            os.chown(self.directory, owner.pw_uid, owner.pw_gid)
        self._run(
            "initdb",
            "--no-sync",
            "--auth=trust",
            "--username=dcam",
            "--encoding=UTF8",
            "--no-locale",
            "-D",
            str(self.data),
        )
        self.start()

    @property
    def data(self) -> Path:
        return self.directory / "data"

    def start(self) -> None:
        settings = (
            *("-h 127.0.0.1", f"-p {self.port}", f"-k {self.directory}", "-c fsync=off"),
            *(f"-c {one}" for one in self._settings),
        )
        log = str(self.directory / "log")
        self._run(
            "pg_ctl",
            "-D",
            str(self.data),
            "-w",
            "-t",
            "120",
            "-l",
            log,
            "-o",
            " ".join(settings),
            "start",
        )

    def stop(self) -> None:
        """As a power failure would: nobody is told."""
        self._run("pg_ctl", "-D", str(self.data), "-w", "-m", "immediate", "stop")

    def remove(self) -> None:
        with suppress(subprocess.CalledProcessError):
            self.stop()
        shutil.rmtree(self.directory, ignore_errors=True)

    def url(self, database: str, port: int | None = None) -> str:
        return f"postgresql://dcam@127.0.0.1:{port or self.port}/{database}"

    def _run(self, program: str, *words: str) -> None:
        user = {"user": _USER, "group": pwd.getpwnam(_USER).pw_gid} if os.getuid() == 0 else {}
        subprocess.run(
            [str(self._programs / program), *words],
            check=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            cwd="/",
            **user,
        )


class Proxy:
    """A TCP line to a server. `allowance` says of each connection after how many bytes it is cut.

    It is given how many were cut; None: never. Whatever is on its way is lost in both directions.
    """

    def __init__(
        self,
        port: int,
        allowance: Callable[[int], int | None],
        at_bytes: int = 0,
        then: Callable[[], None] = lambda: None,
    ) -> None:
        """After `at_bytes` in all `then` is called, once."""
        self._to, self._allowance = port, allowance
        self._until, self._then = at_bytes, then
        self.cuts = 0
        self._listening = socket.create_server(("127.0.0.1", 0), backlog=256)
        self.port = int(self._listening.getsockname()[1])
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def close(self) -> None:
        """Take no more connections; wait for those that there are."""
        self._listening.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        self._listening.close()

    def count(self, size: int) -> None:
        """Take note of bytes that are about to go through."""
        due = 0 < self._until <= size
        self._until -= size
        if due:
            self._then()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listening.accept()
            except OSError:
                return
            line = _Line(self, client, self._allowance(self.cuts))
            self._threads.append(threading.Thread(target=line.run, args=(self._to,)))
            self._threads[-1].start()


class _Line:
    def __init__(self, proxy: Proxy, client: socket.socket, left: int | None) -> None:
        self._proxy, self._client, self._left = proxy, client, left
        self._is_cut = False

    def run(self, port: int) -> None:
        with (
            self._client as client,
            suppress(OSError),
            socket.create_connection(("127.0.0.1", port)) as server,
        ):
            ends = client, server
            back = threading.Thread(target=self._pump, args=(server, client, ends))
            back.start()
            self._pump(client, server, ends)
            back.join()

    def _cut(self) -> None:
        """Count it once, whichever direction was first."""
        if not self._is_cut:
            self._is_cut = True
            self._proxy.cuts += 1

    def _pump(
        self, source: socket.socket, target: socket.socket, ends: tuple[socket.socket, ...]
    ) -> None:
        with suppress(OSError):
            while data := source.recv(16_384):
                if self._left is not None:
                    if len(data) >= self._left:
                        self._cut()
                        break
                    self._left -= len(data)
                self._proxy.count(len(data))
                target.sendall(data)
        for end in ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


def cut_at_random(
    seed: int, cuts: int, most_bytes: int, after: Callable[[int], None] = lambda _number: None
) -> Callable[[int], int | None]:
    """Cut so many times, each time a connection after a random number of bytes.

    `after` is called with the number of each cut as the next connection comes.
    """
    draw, said = random.Random(seed), itertools.count(1)
    pending = next(said)

    def allowance(done: int) -> int | None:
        nonlocal pending
        while pending <= done:
            number, pending = pending, next(said)
            after(number)
        return draw.randrange(1, most_bytes) if done < cuts else None

    return allowance
