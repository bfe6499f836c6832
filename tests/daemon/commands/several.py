"""A program that runs one `dcam-ctl` command after the other, of a JSON list."""

from __future__ import annotations

import json
import sys

from daemon.ctl import cli
from daemon.error_report import run

if __name__ == "__main__":
    for words in json.loads(sys.argv[1]):
        print(f"== exit code {run(cli, 'dcam-ctl', words)}", flush=True)  # noqa: T201
