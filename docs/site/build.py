"""Build the documents as a site: `make docs`, or build.py OUTPUT. A broken link ends it.

The pages of docs/ are taken as they are; those on commands, keys and reasons are written from the
code (reference.py). A page that NAVIGATION does not name comes last.
"""

from __future__ import annotations

import gc
import shutil
import sys
import tempfile
from pathlib import Path

from reference import REFERENCE
from sphinx.cmd.build import build_main

HERE = Path(__file__).parent
DOCS = HERE.parent

STUDIES = ("numerical", "laboratory", "field", "sensitivity", "peers")
NAVIGATION = {
    "At the pier": [
        *("start", "install", "pier", "reading", "troubles", "web", "alarms", "analysis", "ledger"),
        *("compare", "report", "outputs"),
    ],
    "Reference": ["commands", "keys", "columns", "reasons", "conventions", "functions"],
    "How it works": [
        *("method", "architecture", "promises", "benchmarks", "scale", "decisions/README"),
    ],
    "Studies": ["studies/README", *(f"studies/{name}" for name in STUDIES)],
    "Limits and changes": ["untested", "CHANGELOG"],
}
INDEX = """# dcam

How far a bridge moves, measured for months by two cameras on a pier that moves too.

**New here?** [From unpacking to the first value](start.md): one page, no hardware needed.

**At the pier?** [Install](install.md), then [plan, mount, aim, calibrate](pier.md). How to read
what comes out: [values and their sigma](reading.md). Something is wrong: [by symptom](troubles.md).

**Looking something up?** [Commands](commands.md), [keys of the config](keys.md),
[columns](columns.md), [reasons and causes](reasons.md).

**To what extent can it be trusted?** [The method and its limits](method.md), and
[what was never tried on hardware](untested.md).
"""


def lay_out(directory: Path) -> None:
    """Fill a directory with every page, the settings, and the index with its navigation."""
    shutil.copytree(
        DOCS,
        directory,
        ignore=shutil.ignore_patterns("site", "*.py", "__pycache__"),
        dirs_exist_ok=True,
    )
    shutil.copy(HERE / "conf.py", directory)
    changes = (DOCS.parent / "CHANGELOG.md").read_text(encoding="utf-8")
    (directory / "CHANGELOG.md").write_text(changes.replace("](docs/", "]("), encoding="utf-8")
    for name, write in REFERENCE.items():
        (directory / f"{name}.md").write_text(write(), encoding="utf-8")
    there = {str(path.relative_to(directory).with_suffix("")) for path in directory.rglob("*.md")}
    decisions = sorted(name for name in there if name.startswith("decisions/0"))
    _add_navigation(
        directory / "decisions/README.md", {"": [name.partition("/")[2] for name in decisions]}
    )
    named = {name for names in NAVIGATION.values() for name in names}
    parts = {part: [name for name in names if name in there] for part, names in NAVIGATION.items()}
    parts["More"] = sorted(there - named - set(decisions))
    (directory / "index.md").write_text(INDEX, encoding="utf-8")
    _add_navigation(directory / "index.md", parts)


def _add_navigation(page: Path, parts: dict[str, list[str]]) -> None:
    lines = []
    for part, names in parts.items():
        if names:
            caption = [f":caption: {part}"] if part else []
            lines += ["", "```{toctree}", ":hidden:", *caption, "", *names, "```"]
    with page.open("a", encoding="utf-8") as file:
        file.write("\n".join([*lines, ""]))


def main() -> int:
    """Build, and give Sphinx's exit code."""
    gc.disable()  # pages are kept to the end: to look for garbage takes a third of the time
    output = Path(sys.argv[1]).resolve()
    with tempfile.TemporaryDirectory() as directory:
        lay_out(Path(directory))
        code = build_main(
            ["-W", "--keep-going", "-q", "-E", "-d", f"{directory}/.made", directory, str(output)]
        )
    if code == 0:
        print(f"dcam: {output}/index.html")
    return code


if __name__ == "__main__":
    sys.exit(main())
