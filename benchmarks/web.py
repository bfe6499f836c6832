"""The page under load: 200 readers at a time, some of whom never read; its memory, its times.

    .venv/bin/python -m benchmarks.web CONFIG STATE

beside a dcamd or without one: `dcam-ctl gaps` says afterwards whether a slot was late.
"""

from __future__ import annotations

import asyncio
import socket
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

from benchmarks.page_server import rss_mb, running

READERS = 200
SECONDS = 60.0
AT_REST_S = 10.0
SILENT = 40
"""Of them ask for much and take nothing."""
QUANTITIES = "y_mm.main,sigma_y_mm.main,raw_y_mm.main,temperature_main_c,temperature_sub_c"
PATHS = (
    "/",
    "/api/overview",
    f"/api/series?quantities={QUANTITIES}&since=2016-01-01&until=2030-01-01&buckets=2000",
    "/api/spans?since=2016-01-01&until=2030-01-01",
    "/api/days",
    "/static/panel.js",
)


async def _read(port: int, number: int, until_s: float, times_s: list[float]) -> None:
    while time.monotonic() < until_s:
        begun_s = time.monotonic()
        path = PATHS[(number + len(times_s)) % len(PATHS)]
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(
            f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode()
        )
        await reader.read()
        writer.close()
        times_s.append(time.monotonic() - begun_s)


def _silent(port: int) -> socket.socket:
    """Ask for a large answer, and never read it."""
    asking = socket.socket()
    asking.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    asking.connect(("127.0.0.1", port))
    asking.sendall(f"GET {PATHS[2]} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    return asking


async def _load(port: int, process: int) -> tuple[list[float], float]:
    times_s: list[float] = []
    until_s = time.monotonic() + SECONDS
    readers = [_read(port, number, until_s, times_s) for number in range(READERS - SILENT)]
    silent = [_silent(port) for _ in range(SILENT)]
    highest = 0.0

    async def watch() -> None:
        nonlocal highest
        while time.monotonic() < until_s:
            highest = max(highest, rss_mb(process))
            await asyncio.sleep(0.2)

    await asyncio.gather(watch(), *readers)
    for one in silent:
        one.close()
    return times_s, highest


def main() -> None:
    """Measure, and print."""
    with running(Path(sys.argv[1]), Path(sys.argv[2])) as (process, url):
        time.sleep(AT_REST_S)
        rest = rss_mb(process)
        times_s, highest = asyncio.run(_load(urlsplit(url).port or 80, process))
        time.sleep(AT_REST_S)
        times_s.sort()
        print(
            f"at rest {rest:.0f} MB, under load at most {highest:.0f} MB,"
            f" after it {rss_mb(process):.0f} MB"
        )
        print(
            f"{len(times_s)} answers in {SECONDS:.0f} s, median {times_s[len(times_s) // 2]:.3f} s"
        )


if __name__ == "__main__":
    main()
