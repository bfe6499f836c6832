"""The page's side of a worker: started when it is needed, ended when it is idle or hangs."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from daemon.loop_cache import loop_cache
from daemon.web.asking import AskedWronglyError

IDLE_S = 60.0
MOST_WAITING = 12
_LONGEST_ANSWER = 64 * 2**20


class WorkerError(Exception):
    """No answer; the message is one line for people."""


class Worker:
    """Answers one question after another, by `python -m MODULE PATH ...`."""

    def __init__(self, module: str, *paths: Path, does: str, deadline_s: float) -> None:
        self._command = (sys.executable, "-m", module, *map(str, paths))
        self._does = does
        self._deadline_s = deadline_s
        self._process: asyncio.subprocess.Process | None = None
        self._turn = asyncio.Lock()
        self._waiting = 0
        self._idle: asyncio.TimerHandle | None = None

    async def ask(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """Ask, and wait for the answer. Raises WorkerError, AskedWronglyError."""
        if self._waiting >= MOST_WAITING:
            msg = f"{self._does}: too many ask at once; try again"
            raise WorkerError(msg)
        self._waiting += 1
        try:
            async with self._turn:
                return await self._answer(asked)
        finally:
            self._waiting -= 1

    async def _answer(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        if self._idle is not None:
            self._idle.cancel()
        try:
            async with asyncio.timeout(self._deadline_s):
                process = await self._running()
                assert process.stdin is not None  # noqa: S101 - piped
                assert process.stdout is not None  # noqa: S101 - piped
                process.stdin.write(json.dumps(asked).encode() + b"\n")
                await process.stdin.drain()
                line = await process.stdout.readline()
        except TimeoutError:
            self._kill()
            msg = f"{self._does}: no answer within {self._deadline_s:.0f} s; try again"
            raise WorkerError(msg) from None
        except (OSError, ValueError) as error:
            self._kill()
            msg = f"{self._does}: {error}"
            raise WorkerError(msg) from None
        except asyncio.CancelledError:  # the next answer must not be taken for the next question's
            self._kill()
            raise
        self._idle = asyncio.get_running_loop().call_later(IDLE_S, self._kill)
        if not line:
            self._kill()
            msg = f"{self._does}: the process ended; the log of dcam-web says why"
            raise WorkerError(msg)
        said: dict[str, Any] = json.loads(line)
        if "asked_wrongly" in said:
            raise AskedWronglyError(said["asked_wrongly"])
        if "error" in said:
            raise WorkerError(said["error"])
        return said

    async def _running(self) -> asyncio.subprocess.Process:
        if self._process is None or self._process.returncode is not None:
            self._process = await asyncio.create_subprocess_exec(
                *self._command,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                limit=_LONGEST_ANSWER,
                env=_environment(),
            )
        return self._process

    def _kill(self) -> None:
        if self._process is not None and self._process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                self._process.kill()
        self._process = None

    def end(self) -> None:
        """End the process, from any thread; the next question starts another."""
        process = self._process
        if process is not None and process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.kill()

    async def close(self) -> None:
        """End the process."""
        if self._idle is not None:
            self._idle.cancel()
        process = self._process
        self._kill()
        if process is not None:
            await process.wait()


def _environment() -> dict[str, str]:
    """This process's own, with docstrings: numerical libraries may work by them."""
    cache = loop_cache()
    named = {"NUMBA_CACHE_DIR": cache} if cache else {}
    return {name: said for name, said in os.environ.items() if name != "PYTHONOPTIMIZE"} | named
