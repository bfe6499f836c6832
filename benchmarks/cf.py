"""Whether the CF checker finds an error in what `dcam-ctl export --format netcdf` writes.

`make cf` gets the IOOS compliance checker from PyPI, into a place of its own, and runs this. Exit
code 1: it found something; its own words say what.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.page_record import write_record
from daemon.config.reading import load_config

ROOT = Path(__file__).parents[1]
SLOTS = 6000
"""With a gap, runs of flags, readings and two further targets."""
PLACE = 'name = "pier-3"\nlatitude_deg = 47.4\nlongitude_deg = 8.5'
"""CF asks for the place of a station."""


def main() -> None:
    """Write a record, export it, and have the checker look at the file."""
    checker = sys.argv[1]
    with tempfile.TemporaryDirectory(prefix="dcam-cf-") as scratch:
        directory = Path(scratch)
        config, exported = directory / "dcam.toml", directory / "record.nc"
        text = (ROOT / "benchmarks/small.toml").read_text(encoding="utf-8")
        config.write_text(text.replace('name = "small"', PLACE), encoding="utf-8")
        write_record(directory / "state", load_config(config).site(), SLOTS, framed=0)
        where = ["--config", str(config), "--state", str(directory / "state")]
        export = [sys.executable, "-m", "daemon.ctl", "export", *where]
        export += ["--format", "netcdf", "--output", str(exported)]
        subprocess.run(export, check=True)
        check = [checker, "--test=cf:1.11", "--criteria=lenient", str(exported)]
        sys.exit(subprocess.run(check, check=False).returncode)


if __name__ == "__main__":
    main()
