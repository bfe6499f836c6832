"""The pages that are written from the code: commands, keys of the config, reasons and causes."""

from __future__ import annotations

import importlib
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from core.results import Reason
from daemon.config.reading import Config
from daemon.store.records import GapCause

ROOT = Path(__file__).parents[2]
PIER = (ROOT / "docs/pier.md").read_text(encoding="utf-8")
EXAMPLE = (ROOT / "config.example.toml").read_text(encoding="utf-8")
TABLE = re.compile(r"^#? ?\[\[?([\w.]+)\]\]?", re.MULTILINE)
LIMITS = {"minimum": "≥", "maximum": "≤", "exclusiveMinimum": ">", "exclusiveMaximum": "<"}


def programs() -> dict[str, click.Command]:
    """Give the programs that an installation brings, by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    modules = {name: target.partition(":")[0] for name, target in project["scripts"].items()}
    return {name: importlib.import_module(modules[name]).cli for name in sorted(modules)}


def commands_of(
    command: click.Command, name: str, parent: click.Context | None = None
) -> Iterator[tuple[str, click.Context]]:
    """Yield a command and all below it: what is typed, and click's context for its help."""
    context = click.Context(command, info_name=name, parent=parent, max_content_width=96)
    yield context.command_path, context
    if isinstance(command, click.Group):
        for below in command.list_commands(context):
            found = command.get_command(context, below)
            if found is not None and not found.hidden:
                yield from commands_of(found, below, context)


def commands() -> str:
    """Every program and command, as its `--help` says."""
    page = ["# Commands", "", "Each says the same of itself: `dcam-ctl calibrate --help`."]
    for name, program in programs().items():
        for path, context in commands_of(program, name):
            level = "##" if path == name else "###"
            page += ["", f"{level} {path}", "", "```text", context.get_help(), "```"]
    return "\n".join([*page, ""])


def keys() -> str:
    """Every key of `dcam.toml`: kind, limits, default from the model, and what the example says."""
    page = [
        *("# Keys of the config", ""),
        "What `dcam.toml` may hold, table by table, as `config.example.toml` explains it.",
        "A key without a default is either required or left out; unknown keys are refused.",
    ]
    said = sections(EXAMPLE)
    for table, properties in tables():
        page += ["", f"## [{table}]", "", "| key | kind | default |", "| --- | --- | --- |"]
        page += [f"| `{key}` | {kind} | {default} |" for key, kind, default in properties]
        if table in said:
            page += ["", "```toml", said[table].rstrip(), "```"]
    return "\n".join([*page, ""])


def reasons() -> str:
    """Every reason of a row and cause of a gap, with what pier.md says of it."""
    page = [
        *("# Reasons and causes", ""),
        "Why a row is not good, and why slots have no row: closed lists, the same in the database,",
        "the exports and the messages. By symptom: [troubles](troubles.md).",
        *("", "## Why a row is not good", "", "| reason | meaning, cure |", "| --- | --- |"),
        *(f"| `{reason}` | {_said_of(reason)} |" for reason in Reason),
        *("", "## Why slots have no row", "", "| cause | meaning, cure |", "| --- | --- |"),
        *(f"| `{cause}` | {_said_of(cause)} |" for cause in GapCause),
    ]
    return "\n".join([*page, ""])


def untested() -> str:
    """What pier.md and method.md say was never tried."""
    return "\n".join(
        [
            *("# What was never tried on hardware", "", _chapter(PIER, "tried on hardware")),
            *("", "## Of the method", ""),
            _chapter((ROOT / "docs/method.md").read_text(encoding="utf-8"), "was never tested"),
        ]
    )


def _chapter(page: str, heading: str) -> str:
    """Text below the heading that ends so."""
    return (
        re.split(rf"^## .*{heading}$", page, flags=re.MULTILINE)[1].split("\n## ")[0].strip() + "\n"
    )


def _said_of(word: str) -> str:
    """What a table of pier.md says of a reason; raises ValueError when none does."""
    for names, text in re.findall(r"^\| (`.*?) \| (.*) \|$", PIER, flags=re.MULTILINE):
        if f"`{word}`" in names:
            return str(text).replace("](#", "](pier.md#")
    msg = f"docs/pier.md says nothing of `{word}` in a table"
    raise ValueError(msg)


def sections(example: str) -> dict[str, str]:
    """Split the example: table to its lines."""
    starts = list(TABLE.finditer(example))
    ends = [start.start() for start in starts[1:]] + [len(example)]
    found: dict[str, str] = {}
    for start, end in zip(starts, ends, strict=True):
        text = re.sub(r"^# -{10,}.*$", "", example[start.start() : end], flags=re.MULTILINE)
        found[start[1]] = found.get(start[1], "") + text
    return found


def tables() -> Iterator[tuple[str, list[tuple[str, str, str]]]]:
    """Yield every table of the config with its keys, each with kind and default."""
    schema = Config.model_json_schema()
    yield from _tables(schema, schema)


def _tables(
    schema: dict[str, Any], whole: dict[str, Any], above: str = ""
) -> Iterator[tuple[str, list[tuple[str, str, str]]]]:
    """Yield a table, if it has keys of its own, and those below it."""
    plain, below = [], []
    required = schema.get("required", [])
    for key, described in schema["properties"].items():
        inner = next((part for part in _parts(described, whole) if "properties" in part), None)
        if inner is not None:
            below.append((f"{above}{key}", inner))
            continue
        plain.append((key, _kind(described, whole), _default(described, required=key in required)))
    if plain:
        yield above.rstrip("."), plain
    for name, inner in below:
        yield from _tables(inner, whole, f"{name}.")


def _parts(described: dict[str, Any], whole: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield what a key may be, references followed, lists by what they hold."""
    if "$ref" in described:
        described = whole["$defs"][described["$ref"].rpartition("/")[2]]
    options = described.get("anyOf") or described.get("oneOf")
    if options:
        for option in options:
            yield from _parts(option, whole)
    elif isinstance(described.get("items"), dict) and "$ref" in described["items"]:
        yield from _parts(described["items"], whole)
    else:
        yield described


def _kind(described: dict[str, Any], whole: dict[str, Any]) -> str:
    kinds = []
    for part in _parts(described, whole):
        if part.get("type") == "null":
            continue
        choices = part.get("enum") or ([part["const"]] if "const" in part else [])
        if choices:
            kinds.append(", ".join(f"`{choice}`" for choice in choices))
            continue
        limits = [f"{sign} {part[key]}" for key, sign in LIMITS.items() if key in part]
        kinds.append(" ".join([str(part.get("type", "list")), *limits]))
    return " or ".join(dict.fromkeys(kinds))


def _default(described: dict[str, Any], *, required: bool) -> str:
    if required:
        return "required"
    default = described.get("default")
    return "" if default is None else f"`{default}`"


REFERENCE = {"commands": commands, "keys": keys, "reasons": reasons, "untested": untested}
"""Name of the page and what writes it."""
