"""One clear line for each thing wrong in a config: file, dotted key, what to write instead."""

from __future__ import annotations

import difflib
import re
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

Location = tuple[int | str, ...]

_UNQUOTED = ("alarm", "web")
"""No value and no unknown key of them is ever quoted, but of the alarm's own tables."""
_QUOTED = ("value", "rate", "reading")
"""Of [alarm]: what holds no password."""
_CREDENTIALS = re.compile(r"://[^/@\s]*@")
_LONGEST_QUOTE = 200

_TOO_SMALL = {"greater_than", "greater_than_equal"}
_TOO_LARGE = {"less_than", "less_than_equal"}
_BOUND_WORDS = {
    "greater_than": ("gt", "greater than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}
_TYPE_WORDS = {
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "a text in quotes",
    "bool_type": "true or false",
    "tuple_type": "a list",
    "path_type": "a text in quotes",
    "model_type": "a table",
    "model_attributes_type": "a table",
}
_OTHER_UNITS = {
    # key ending: (what a value too small may be in, what a value too large may be in)
    "_mm": ("metres", "micrometres"),
    "_um": ("millimetres", "nanometres"),
    "_us": ("milliseconds", "nanoseconds"),
    "_ms": ("seconds", "microseconds"),
    "_s": (None, "milliseconds"),
    "_deg": ("radians", None),
}


def describe_problems(error: ValidationError, model: type[BaseModel], path: Path) -> list[str]:
    """Turn pydantic's findings into lines such as `dcam.toml: rig.offset_mm: unknown key ...`."""
    details = error.errors(include_url=False)
    meant = {
        (*item["loc"][:-1], name)
        for item in details
        if item["type"] == "extra_forbidden" and (name := _nearest_name(model, item["loc"]))
    }
    return [
        f"{path}: {dotted(_named(model, item))}: {_describe(item, model)}"
        for item in details
        # A misspelt required key would be reported twice: as unknown and as missing.
        if not (item["type"] == "missing" and item["loc"] in meant)
        # So would a wrong value in a list, which is then too short without it.
        and not (item["type"] == "too_short" and _has_wrong_value(item["loc"], details))
    ]


def _named(model: type[BaseModel], item: ErrorDetails) -> Location:
    """The location as a message may name it."""
    location = item["loc"]
    if item["type"] != "extra_forbidden" or not _is_secret(location):
        return location
    return location if _nearest_name(model, location) else (*location[:-1], "a key (not shown)")


def _is_secret(location: Location) -> bool:
    return location[:1] in [(name,) for name in _UNQUOTED] and location[1:2] not in [
        (name,) for name in _QUOTED
    ]


def _has_wrong_value(location: Location, details: list[ErrorDetails]) -> bool:
    depth = len(location)
    return any(len(item["loc"]) > depth and item["loc"][:depth] == location for item in details)


def dotted(location: Location) -> str:
    """Write a location as the user knows it: `target.main.centres_mm[2][0]`."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    return text.removeprefix(".")


def _describe(item: ErrorDetails, model: type[BaseModel]) -> str:
    kind, context = item["type"], item.get("ctx", {})
    shown = _shown(item["loc"], item["input"])
    if kind == "extra_forbidden":
        return _describe_unknown(model, item["loc"])
    if kind == "missing":
        return _describe_missing(item["loc"])
    if kind == "literal_error":
        return f"must be one of {context['expected']}, is {shown}"
    if kind == "finite_number":
        return f"must be a finite number, is {shown}"
    if kind in _TYPE_WORDS:
        return f"must be {_TYPE_WORDS[kind]}, is {shown}"
    if kind in _BOUND_WORDS:
        name, words = _BOUND_WORDS[kind]
        return f"must be {words} {context[name]}, is {shown}{_unit_hint(item)}"
    if kind in {"too_long", "too_short"}:
        limit = context.get("max_length", context.get("min_length"))
        most = "at most" if kind == "too_long" else "at least"
        return f"must have {most} {limit} values, has {context['actual_length']}"
    if kind.startswith(("datetime", "timezone", "time_zone")):
        return f"must be a time in UTC such as 2026-03-01T00:00:00Z, is {shown}"
    if kind == "string_pattern_mismatch":  # there is one pattern, that of names
        return f"must be made of a-z, 0-9 and -, at most 32, is {shown}"
    if kind == "string_too_long":
        return f"must have at most {context['max_length']} characters, is {shown}"
    if kind == "string_too_short":
        return "must not be empty"
    return f"{item['msg']}, is {shown}"


def _shown(location: Location, value: object) -> str:
    """A value as a message may quote it: those of `[alarm]` hold passwords and tokens."""
    if _is_secret(location):
        return "something else (not shown here: it may hold a password)"
    text = _CREDENTIALS.sub("://...@", repr(value) if isinstance(value, str) else str(value))
    return text if len(text) <= _LONGEST_QUOTE else f"{text[:_LONGEST_QUOTE]}..."


def _describe_missing(location: Location) -> str:
    if isinstance(location[-1], int):
        return f"missing: the list is too short, value {location[-1] + 1} is not there"
    return "missing; every site needs it (config.example.toml says what it is)"


def _describe_unknown(model: type[BaseModel], location: Location) -> str:
    nearest = _nearest_name(model, location)
    if nearest:
        return f"unknown key; did you mean {dotted((*location[:-1], nearest))}?"
    elsewhere = [path for path in _all_keys(model) if path[-1] == location[-1]]
    if elsewhere:
        return f"unknown key; did you mean {dotted(elsewhere[0])}?"
    return f"unknown key; known here: {', '.join(_known_names(model, location[:-1]))}"


def _nearest_name(model: type[BaseModel], location: Location) -> str | None:
    known = _known_names(model, location[:-1])
    written = str(location[-1]).lower()
    close = difflib.get_close_matches(written, known, n=1, cutoff=0.6)
    abbreviated = [name for name in known if name.startswith(written)]
    return next(iter(close or abbreviated), None)


def _known_names(model: type[BaseModel], section: Location) -> list[str]:
    for name in (part for part in section if isinstance(part, str)):
        inner = next((_section(field) for key, field in _fields(model) if key == name), None)
        if inner is None:
            return []
        model = inner
    return [key for key, _ in _fields(model)]


def _all_keys(model: type[BaseModel], above: tuple[str, ...] = ()) -> list[tuple[str, ...]]:
    keys = []
    for key, field in _fields(model):
        keys.append((*above, key))
        inner = _section(field)
        if inner is not None:
            keys += _all_keys(inner, (*above, key))
    return keys


def _fields(model: type[BaseModel]) -> list[tuple[str, Any]]:
    return [(field.alias or name, field) for name, field in model.model_fields.items()]


def _section(field: Any) -> type[BaseModel] | None:
    """Give the model of a table, or of each table in a list of tables."""
    for annotation in (field.annotation, *get_args(field.annotation)):
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            return annotation
    return None


def _unit_hint(item: ErrorDetails) -> str:
    """Ask whether a value out of bounds is in another unit than the key says."""
    key = next(part for part in reversed(item["loc"]) if isinstance(part, str))
    smaller, larger = next(
        (units for ending, units in _OTHER_UNITS.items() if key.endswith(ending)), (None, None)
    )
    if item["type"] in _TOO_SMALL and item["input"] > 0 and smaller:
        return f"; is this in {smaller}?"
    if item["type"] in _TOO_LARGE and larger:
        return f"; is this in {larger}?"
    return ""
