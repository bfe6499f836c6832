"""The control socket: how `dcam-ctl` asks a running dcamd for the cameras, a look, a new config.

A Unix stream socket; each request and each answer is one line of JSON. A pause is held by the
connection that asked for it: when that closes, however it came to that, the daemon goes on. What
comes in is never trusted: a line too long, no JSON, too many or too slow connections end that
connection and touch nothing else.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import structlog
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from daemon.control.camera_lease import CameraLease
from daemon.control.run_state import runtime_directory
from daemon.error_report import exit_code_of, lines_of
from daemon.errors import ExitCode, HardwareError, error_of
from daemon.lock import sole_writer
from daemon.version import VERSION

_log = structlog.get_logger("dcam.daemon")

SOCKET_NAME = "control.sock"
MAX_LINE_BYTES = 2000
MAX_CONNECTIONS = 16
REQUEST_TIMEOUT_S = 10.0
"""A connection that asks for nothing, or does not read its answer, is closed after this time."""
PAUSE_LIMIT_S = 3600.0
"""A pause ends after this time even if its holder only hangs; to pause again renews it."""
PAUSE_TIMEOUT_S = 120.0
"""How long a client waits for the slot in progress to end."""
MAX_ANSWER_BYTES = 20_000
MAX_ERROR = 4000


class Request(BaseModel):
    """One line from a client."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

    command: Literal["status", "pause", "resume", "capture", "reload"]
    reason: str = Field(default="", max_length=200)
    """Why the daemon is to pause, for the gap's detail."""


class Answer(BaseModel):
    """One line from the daemon."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    ok: bool
    error: str = ""
    version: str = VERSION
    exit_code: ExitCode = ExitCode.HARDWARE
    """Of a command that fails with this error."""
    paused: str = ""
    """Why it is paused; empty while it measures."""
    look: dict[str, Any] | None = None
    """What a capture saw."""


@dataclass(frozen=True, slots=True)
class CommandHandlers:
    """What else the daemon does when it is asked; called in threads, one at a time."""

    capture: Callable[[], dict[str, Any]]
    """Take and measure a slot's pairs between two slots."""
    reload: Callable[[], None]
    """Read the config again; raises where it is wrong, and the old one stays."""


@contextmanager
def _address(directory: Path) -> Iterator[str]:
    """A path to the socket that is short enough for any directory (the kernel takes 107 bytes)."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield f"/proc/self/fd/{descriptor}/{SOCKET_NAME}"
    finally:
        os.close(descriptor)


# ---------------------------------------------------------------------------------- the daemon


@contextmanager
def control_socket(
    state: Path, lease: CameraLease, handlers: CommandHandlers | None = None
) -> Iterator[None]:
    """Answer on the control socket while the block runs, in a thread of its own.

    Where no socket can be made the daemon measures all the same; its log says why.
    """
    directory = runtime_directory(state)
    try:
        listening = _listen(directory)
    except OSError as error:
        _log.warning("no_control_socket", directory=str(directory), error=str(error))
        yield
        return
    server = _Server(lease, handlers)
    thread = threading.Thread(target=server.run, args=(listening,), name="control", daemon=True)
    thread.start()
    try:
        yield
    finally:
        server.stop()
        thread.join(REQUEST_TIMEOUT_S)
        (directory / SOCKET_NAME).unlink(missing_ok=True)


def _listen(directory: Path) -> socket.socket:
    """Make the socket, for owner and group; whoever calls is the directory's only daemon."""
    (directory / SOCKET_NAME).unlink(missing_ok=True)
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with _address(directory) as address:
            listening.bind(address)
        (directory / SOCKET_NAME).chmod(0o660)
        listening.listen(MAX_CONNECTIONS)
    except OSError:
        listening.close()
        raise
    return listening


class _Server:
    """The connections, on an event loop of their own."""

    def __init__(self, lease: CameraLease, handlers: CommandHandlers | None) -> None:
        self._lease = lease
        self._handlers = handlers
        self._busy = ""
        """What is being done for a client, of that which is done for one at a time."""
        self._started = threading.Event()
        self._idle: dict[object, asyncio.StreamWriter] = {}
        """Connections that hold no pause and are not being served, the oldest first."""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ended: asyncio.Event

    def run(self, listening: socket.socket) -> None:
        try:
            asyncio.run(self._serve(listening))
        except OSError as error:  # no descriptor was left for the loop
            _log.warning("no_control_socket", error=str(error))
        finally:
            listening.close()
            self._started.set()

    def stop(self) -> None:
        self._started.wait()
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # it has ended by itself
                self._loop.call_soon_threadsafe(self._ended.set)

    async def _serve(self, listening: socket.socket) -> None:
        self._loop, self._ended = asyncio.get_running_loop(), asyncio.Event()
        self._started.set()
        server = await asyncio.start_unix_server(
            self._serve_one, sock=listening, limit=MAX_LINE_BYTES
        )
        async with server:
            await self._ended.wait()

    async def _serve_one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        holder = object()
        self._idle[holder] = writer
        if len(self._idle) > MAX_CONNECTIONS:  # a crowd pushes itself out, not the newest
            self._idle.pop(next(iter(self._idle))).transport.abort()
        try:
            await self._converse(reader, writer, holder)
        except (OSError, ValueError, asyncio.IncompleteReadError):
            pass  # the client went away, was too slow, or sent no line
        finally:
            self._idle.pop(holder, None)
            writer.transport.abort()

    async def _converse(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, holder: object
    ) -> None:
        """Answer line after line; a pause ends with its connection."""
        try:
            while True:
                patience_s = PAUSE_LIMIT_S if self._lease.held_by(holder) else REQUEST_TIMEOUT_S
                line = await asyncio.wait_for(reader.readline(), patience_s)
                if not line:
                    return
                answer = await self._answer(line, holder)
                writer.write(answer.model_dump_json().encode() + b"\n")
                await asyncio.wait_for(writer.drain(), REQUEST_TIMEOUT_S)
        finally:
            # The slot in progress may hold the switch: no waiting in the event loop.
            await asyncio.shield(asyncio.to_thread(self._lease.release, holder))

    async def _answer(self, line: bytes, holder: object) -> Answer:
        try:
            request = Request.model_validate_json(line)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"])
            return Answer(ok=False, error=f"not understood: {where}: {first['msg']}".strip(": "))
        if request.command == "pause":
            taken = await asyncio.to_thread(self._lease.hold, holder, request.reason or "paused")
            if not taken:
                return Answer(ok=False, error=f"paused already: {self._lease.reason}")
            self._idle.pop(holder, None)
        elif request.command == "resume":
            await asyncio.to_thread(self._lease.release, holder)
        elif request.command != "status":
            return await self._handled(request.command, holder)
        return Answer(ok=True, paused=self._lease.reason or "")

    async def _handled(self, command: Literal["capture", "reload"], holder: object) -> Answer:
        """Do it in a thread; a crowd that asks for it gets one, and the others are refused."""
        if self._handlers is None or self._busy:
            return Answer(ok=False, error=f"{self._busy or 'start'} in progress; try again later")
        self._busy = command
        writer = self._idle.pop(holder, None)  # a crowd does not push out who is being served
        try:
            look = await asyncio.to_thread(getattr(self._handlers, command))
        except Exception as error:  # noqa: BLE001 - it is the client's to know; slots go on
            code = exit_code_of(error)
            return Answer(ok=False, error="\n".join(lines_of(error))[:MAX_ERROR], exit_code=code)
        finally:
            self._busy = ""
            if writer is not None:
                self._idle[holder] = writer
        return Answer(ok=True, paused=self._lease.reason or "", look=look)


# ---------------------------------------------------------------------------------- the client


@contextmanager
def paused_daemon(state: Path, reason: str) -> Iterator[bool]:
    """Have the dcamd of a state directory pause while the block runs; False: none answers.

    Raises HardwareError when it answers, and does not pause.
    """
    with contextlib.ExitStack() as stack:
        connection = _connect(runtime_directory(state))
        if connection is None:
            yield False
            return
        stack.enter_context(connection)
        answer = _ask(connection, Request(command="pause", reason=reason))
        if not answer.ok:
            msg = f"dcamd of {state} does not pause: {answer.error}; try again later"
            raise HardwareError(msg)
        yield True


def ask_daemon(state: Path, command: Literal["capture", "reload"]) -> Answer | None:
    """Have the dcamd of a state directory do something; None: none answers.

    Raises HardwareError, and what the daemon said as the error that it was.
    """
    connection = _connect(runtime_directory(state))
    if connection is None:
        return None
    with connection:
        answer = _ask(connection, Request(command=command))
    if answer.ok:
        return answer
    lines = (f"dcamd: {line}" for line in answer.error.splitlines())
    raise error_of(answer.exit_code, "\n".join(lines))


@contextmanager
def cameras_to_oneself(state: Path, program: str) -> Iterator[None]:
    """Keep everybody else from the cameras: a running dcamd pauses, else the lock is taken.

    Raises AlreadyRunningError, HardwareError.
    """
    with paused_daemon(state, f"{program} (pid {os.getpid()})") as paused:
        if paused:
            yield
            return
        with sole_writer(state, program):
            yield


def _connect(directory: Path) -> socket.socket | None:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(PAUSE_TIMEOUT_S)
    try:
        with _address(directory) as address:
            connection.connect(address)
    except PermissionError:
        connection.close()
        msg = f"{directory / SOCKET_NAME}: not allowed; join the group dcam, or use sudo"
        raise HardwareError(msg) from None
    except OSError:
        connection.close()
        return None
    return connection


def _ask(connection: socket.socket, request: Request) -> Answer:
    try:
        connection.sendall(request.model_dump_json().encode() + b"\n")
        with connection.makefile("rb") as lines:
            return Answer.model_validate_json(lines.readline(MAX_ANSWER_BYTES))
    except (OSError, ValidationError) as error:
        msg = f"dcamd does not answer on its control socket ({error}); restart it"
        raise HardwareError(msg) from None
