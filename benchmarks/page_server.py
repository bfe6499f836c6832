"""dcam-web beside a record, as a program of its own, in the environment of its unit."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

ROOT = Path(__file__).parents[1]
UNIT = ROOT / "systemd/dcam-web.service"


@contextmanager
def serving(config: Path, state: Path | None) -> Iterator[str]:
    """Run `dcam-web` on a free port while the block runs; gives its address.

    Without a state directory it is that of the config, or all sites of a central database.
    """
    with running(config, state) as (_, url):
        yield url


@contextmanager
def running(config: Path, state: Path | None) -> Iterator[tuple[int, str]]:
    """As `serving`; gives the number of its process, too."""
    command = [sys.executable, "-m", "daemon.web_main", "--port", "0"]
    where = ["--config", str(config), *([] if state is None else ["--state", str(state)])]
    env = {**os.environ, **_said_by_unit()}
    with subprocess.Popen(
        [*command, *where], cwd=ROOT, env=env, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process.pid, _address(process)
        finally:
            process.terminate()


def _said_by_unit() -> dict[str, str]:
    """What changes how Python runs."""
    return dict(re.findall(r"^Environment=(PYTHON\w+)=(\S+)$", UNIT.read_text(), re.MULTILINE))


def wait_until_read(url: str) -> None:
    """Until dcam-web has read the whole record, which it does once: some milliseconds a day."""
    while True:
        with urlopen(f"{url}/api/site") as answer:
            if json.load(answer)["building"] is None:
                return
        time.sleep(1.0)


def rss_mb(process: int) -> float:
    """Memory of a process, files that it shares with others among it, MB."""
    return _memory_mb(process, "VmRSS")


def own_mb(process: int) -> float:
    """Memory of a process without the files of its programs and libraries, MB."""
    return _memory_mb(process, "RssAnon")


def _memory_mb(process: int, what: str) -> float:
    text = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    found = re.search(rf"{what}:\s+(\d+)", text)
    return int(found[1]) / 1024 if found else 0.0


def _address(process: subprocess.Popen[str]) -> str:
    """What it says when it listens. Raises RuntimeError with its own words when it does not."""
    said = []
    for line in process.stderr or ():
        said.append(line)
        if found := re.search(r"(http://\S+?)/ shows (the record|all sites)", line):
            return found[1]
    msg = f"dcam-web does not serve: {''.join(said)}"
    raise RuntimeError(msg)
