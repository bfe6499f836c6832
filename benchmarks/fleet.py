"""A central PostgreSQL under many piers: `python -m benchmarks.fleet --help`.

Two runs: a few piers with long records through cuts and restarts, and very many with a row a
minute each. Each says whether every row is there once, how fast, and how large.
"""

from __future__ import annotations

import argparse
import os
import resource
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from sqlalchemy import insert, text

from benchmarks.record import fill
from daemon.fleet.sync import Sync
from daemon.outputs.backoff import Backoff
from daemon.store.central.connecting import (
    Central,
    CentralAwayError,
    connect_central,
    open_central,
    prepare,
)
from daemon.store.central.site_table import SITE
from daemon.store.central.sites import read_sites
from daemon.store.central.writing import SiteFacts, write_rows
from daemon.times import slot_text
from tests.daemon.fleet.postgres import Proxy, Server, cut_at_random

_MOST_BYTES = 12_000_000
"""Of a connection that is cut: the cuts lie all over the run."""
EXAMPLE = Path(__file__).parents[1] / "config.example.toml"
_BEGIN = datetime(2026, 3, 1, tzinfo=UTC)
_PIERS_A_SECOND = 167


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet", description=__doc__)
    parser.add_argument("--rows", type=int, default=200_000, help="of all long records; 0: none")
    parser.add_argument("--sites", type=int, default=10, help="with long records, in parallel")
    parser.add_argument("--cuts", type=int, default=20)
    parser.add_argument("--piers", type=int, default=10_000, help="with a row a minute")
    parser.add_argument("--seconds", type=int, default=600, help="of the many piers")
    parser.add_argument("--minutes", type=int, default=5, help="from sync to sync of a pier")
    options = parser.parse_args()
    server = Server("shared_buffers=128MB", "max_connections=60")
    try:
        if options.rows:
            long_records(server, options.rows, options.sites, options.cuts)
        many_piers(server, options.piers, options.seconds, options.minutes)
    finally:
        server.remove()


def _new(server: Server, name: str) -> Central:
    first = connect_central(server.url("postgres"), None)
    with first.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
    first.close()
    central = connect_central(server.url(name), None)
    prepare(central)
    central.close()  # the server is restarted meanwhile
    return central


def long_records(server: Server, rows: int, sites: int, cuts: int) -> None:
    """Piers with long records, all at once, through cuts and two restarts."""
    central, restarts = _new(server, "long_records"), list[int]()

    def restart(number: int) -> None:
        if number in {cuts // 3, 2 * cuts // 3}:
            restarts.append(number)
            server.stop()
            server.start()

    with tempfile.TemporaryDirectory() as scratch:
        states = [Path(scratch) / f"pier-{number}" for number in range(sites)]
        for state in states:
            fill(state, rows // sites)
        line = Proxy(server.port, cut_at_random(3, cuts, _MOST_BYTES, restart))
        url, begin_s = server.url("long_records", line.port), time.monotonic()

        def copy(state: Path) -> int:
            sync = Sync(url, None, state, SiteFacts(state.name, 60), backoff=Backoff(0.1, 2.0))
            while True:
                try:
                    return sync.run().outages
                except CentralAwayError:  # the timer starts the next run
                    time.sleep(1.0)

        with ThreadPoolExecutor(sites) as pool:
            outages = sum(pool.map(copy, states))
        took_s = time.monotonic() - begin_s
        line.close()
        right = sum(_same(central, state) for state in states)
        size = sum((state / "dcam.db").stat().st_size for state in states)
    whole = _size(central)
    print(f"{rows} rows of {sites} sites in {took_s:.0f} s, {rows / took_s:.0f} rows/s")
    print(f"  {line.cuts} cuts, {len(restarts)} restarts, {outages} outages seen")
    print(f"  sites whose rows are all there once, by digest: {right} of {sites}")
    print(f"  bytes a row: SQLite {size / rows:.0f}, PostgreSQL {whole / rows:.0f}", flush=True)
    central.close()


def _same(central: Central, state: Path) -> bool:
    with closing(sqlite3.connect(state / "dcam.db")) as connection:
        here = sorted(row[0] for row in connection.execute("SELECT digest FROM measurement"))
    query = text(
        "SELECT digest FROM measurement JOIN site ON site.id = site_id WHERE site.name = :name"
    )
    with central.transaction() as connection_there:
        there = sorted(connection_there.scalars(query, {"name": state.name}))
    return here == there


def _size(central: Central) -> int:
    """Bytes of the rows' months, with indexes."""
    query = (
        "SELECT sum(pg_total_relation_size(inhrelid)) FROM pg_inherits"
        " WHERE inhparent = 'measurement'::regclass"
    )
    with central.transaction() as connection:
        return int(connection.scalar(text(query)) or 0)


def many_piers(server: Server, piers: int, seconds: int, minutes: int) -> None:
    """Very many piers with a row a minute each; what a pier has is a transaction of its own."""
    central = _new(server, "many_piers")
    with tempfile.TemporaryDirectory() as scratch:
        fill(Path(scratch), 10)
        with closing(sqlite3.connect(Path(scratch) / "dcam.db")) as connection:
            connection.row_factory = sqlite3.Row
            row = dict(connection.execute("SELECT * FROM measurement").fetchone())
    # As large as what a pier says: 40 things, each with a sentence.
    one = {"name": "calibration", "level": "ok", "text": "fits the config; made 23 days ago"}
    said = {"level": "ok", "items": [one] * 40}
    sites: list[dict[str, Any]] = [
        {
            "name": f"pier-{number:05d}",
            "identity": str(number),
            "revision": "0012",
            "version": "0.1.0",
            "heard_utc": datetime.now(UTC),
            "period_s": 60,
            "level": 2 if number % 500 == 0 else 0,
            "summary": "coverage 24 h: 99.9 %",
            "alarms": int(number % 500 == 0),
            "status": said,
            "config": EXAMPLE.read_text(encoding="utf-8"),
        }
        for number in range(piers)
    ]
    with central.transaction() as there:
        there.execute(insert(SITE), sites)
    sites_there = [site.id for site in read_sites(central)]
    total = seconds * _PIERS_A_SECOND // minutes
    turns, lock, late_s = iter(range(total)), threading.Lock(), [0.0]
    begin_s, begin_cpu_s = time.monotonic(), (time.process_time(), _server_cpu_s(server))

    def work(_worker: int) -> None:
        own = open_central(server.url("many_piers"), None)
        while True:
            with lock:
                turn = next(turns, None)
            if turn is None:
                break
            due_s = begin_s + turn * minutes / _PIERS_A_SECOND
            time.sleep(max(0.0, due_s - time.monotonic()))
            visit, pier = divmod(turn, piers)
            numbers = range(visit * minutes, (visit + 1) * minutes)
            with own.transaction() as connection:
                write_rows(connection, sites_there[pier], [_minute(row, one) for one in numbers])
                connection.execute(
                    text("UPDATE site SET heard_utc = now(), progress = :at WHERE id = :site"),
                    {"at": f'{{"row_id": {numbers[-1]}}}', "site": sites_there[pier]},
                )
            late_s[0] = max(late_s[0], time.monotonic() - due_s)
        own.close()

    with ThreadPoolExecutor(16) as pool:
        list(pool.map(work, range(16)))
    took_s = time.monotonic() - begin_s
    piers_s = time.process_time() - begin_cpu_s[0]
    server_s = _server_cpu_s(server) - begin_cpu_s[1]
    with central.transaction() as there:
        count = there.scalar(text("SELECT count(*) FROM measurement"))
    rows = total * minutes
    print(f"{piers} piers, {rows} rows in {took_s:.0f} s, {rows / took_s:.0f} rows/s")
    print(f"  rows there, each once: {count} of {rows}; latest sync {late_s[0]:.1f} s late")
    print(f"  processor: server {server_s:.0f} s, piers {piers_s:.0f} s")
    central.close()
    status_of_all(server, piers)


def status_of_all(server: Server, piers: int) -> None:
    """What `dcam-ctl status --fleet` takes, with the start of the program, and what the server."""
    with tempfile.TemporaryDirectory() as scratch:
        config = Path(scratch) / "centre.toml"
        config.write_text(f'[fleet]\nurl = "{server.url("many_piers")}"\n')
        words = [sys.executable, "-m", "daemon.ctl", "--config", str(config), "status", "--fleet"]
        for _ in range(3):
            before, begin_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
            server_s = _server_cpu_s(server)
            subprocess.run(words, check=False, stdout=subprocess.DEVNULL)
            after, took_s = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic() - begin_s
            cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            time.sleep(1.0)  # the server's process for it ends
            server_s = _server_cpu_s(server) - server_s
            print(
                f"  status --fleet of {piers} sites: {took_s:.2f} s, processor {cpu_s:.2f} s, "
                f"server {server_s:.2f} s"
            )


def _server_cpu_s(server: Server) -> float:
    """Of the server and of those of its processes that have ended: connections that are closed."""
    number = (server.data / "postmaster.pid").read_text().split()[0]
    fields = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


def _minute(row: dict[str, Any], minute: int) -> dict[str, Any]:
    """A row of its own minute."""
    slot = slot_text(_BEGIN + timedelta(minutes=minute))
    return {**row, "id": minute + 1, "slot_utc": slot, "redated_from_utc": None}


if __name__ == "__main__":
    main()
