"""Run studies and write their pages: `python -m studies [NAME ...]`, all without a name."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

from daemon.error_report import ignore_older_matplotlib
from studies.keep import ROOT, Keep

STUDIES = ("numerical", "laboratory", "peers", "sensitivity", "field")


def main() -> int:
    """Run the studies named; 1 where one does not show what it must."""
    options = parser().parse_args()
    if unknown := sorted(set(options.names) - set(STUDIES)):
        print(f"studies: no study {unknown[0]!r}; there: {', '.join(STUDIES)}", file=sys.stderr)
        return 2
    ignore_older_matplotlib()  # Debian's, which comes with mrcal
    changed: list[str] = []
    failed: list[str] = []
    for name in options.names or STUDIES:
        study = importlib.import_module(f"studies.{name}")
        keep = Keep(options.out / name, study.CODE)
        report = study.run(keep)
        changed += report.write(options.docs)
        failed += [claim.sentence for claim in report.claims if not claim.holds]
        print(f"{name}: {options.docs / name}.md")
    print(f"{len(changed)} figures differ from before by more than rounding")
    for line in (*changed, *(f"NOT shown: {sentence}" for sentence in failed)):
        print(f"  {line}")
    return 1 if failed else 0


def parser() -> argparse.ArgumentParser:
    """Options."""
    made = argparse.ArgumentParser(prog="python -m studies", description=__doc__)
    known = ", ".join(STUDIES)
    made.add_argument("names", nargs="*", metavar="NAME", help=f"{known}; without one: all")
    made.add_argument("--out", type=Path, default=ROOT / "out" / "studies", help="kept results")
    made.add_argument("--docs", type=Path, default=ROOT / "docs" / "studies", help="pages")
    return made


if __name__ == "__main__":
    sys.exit(main())
