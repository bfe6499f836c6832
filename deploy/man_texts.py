"""Write what man pages are made of: man_texts.py DIRECTORY SOURCE SECONDS.

For each program and command NAME.SECTION.help, as its --help says it, and NAME.SECTION.name with
its one line; and dcam.toml.5 whole.
"""

from __future__ import annotations

import gc
import re
import sys
from datetime import UTC, datetime
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "docs/site"))

from reference import EXAMPLE, commands_of, programs, sections, tables

SERVICES = ("dcamd", "dcam-web")


def write_commands(directory: Path) -> None:
    """Write a file for each program and command."""
    for name, program in programs().items():
        for path, context in commands_of(program, name):
            section = 8 if name in SERVICES else 1
            # help2man knows examples by their prompt.
            before, example, after = context.get_help().partition("  Example:\n")
            text = before + example.replace("  Example:", "Examples:")
            text += re.sub(r"^    ", "  $ ", after, flags=re.MULTILINE)
            page = directory / f"{path.replace(' ', '-')}.{section}"
            page.with_name(f"{page.name}.help").write_text(text + "\n", encoding="utf-8")
            line = context.command.get_short_help_str(limit=200).rstrip(".")
            page.with_name(f"{page.name}.name").write_text(line, encoding="utf-8")


def config_page(source: str, date: str) -> str:
    """Every table of `dcam.toml` with its keys, and the part of the example that explains them."""
    said = sections(EXAMPLE)
    page = [
        f'.TH DCAM.TOML 5 "{date}" "{source}" "File Formats"',
        *(".SH NAME", r"dcam.toml \- config of a dual-camera bridge displacement system"),
        *(".SH SYNOPSIS", ".I /etc/dcam/dcam.toml"),
        ".SH DESCRIPTION",
        "A TOML file. The unit of a value is the end of its key. Unknown keys are refused.",
        ".B dcam-ctl check",
        "says what is wrong in it;",
        ".B systemctl reload dcamd",
        "has a running dcamd read it again.",
        ".SH TABLES",
    ]
    for table, keys in tables():
        page += [f".SS [{table}]"]
        for key, kind, default in keys:
            page += [".TP", rf"\fB{_roff(key)}\fR", _roff(f"{kind}; {_default(default)}")]
        if table in said:
            page += [".PP", ".nf", *map(_roff, said[table].strip().splitlines()), ".fi"]
    page += [".SH FILES", ".I config.example.toml", "in /usr/share/dcam or /usr/local/share/dcam"]
    page += [".SH SEE ALSO", ".BR dcamd (8),", ".BR dcam-ctl (1)", ""]
    return "\n".join(page)


def _default(default: str) -> str:
    if default == "required":
        return default
    return f"default {default}" if default else "no default"


def _roff(text: str) -> str:
    plain = text.replace("`", "").replace("\\", r"\e").replace("-", r"\-")
    return rf"\&{plain}" if plain[:1] in {".", "'"} else plain


def main() -> None:
    """Write all into a directory; SOURCE is the name and version at the foot of a page."""
    gc.disable()  # of all that is loaded nothing becomes garbage
    directory, source, seconds = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    date = datetime.fromtimestamp(seconds, UTC).date().isoformat()
    write_commands(directory)
    (directory / "dcam.toml.5").write_text(config_page(source, date), encoding="utf-8")


if __name__ == "__main__":
    main()
