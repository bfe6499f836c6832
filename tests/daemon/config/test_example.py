"""config.example.toml and the model agree, key by key and default by default."""

import re
import tomllib
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from daemon.config.reading import Config, SimulationSection, load_config

EXAMPLE = Path(__file__).parents[3] / "config.example.toml"
TEXT = EXAMPLE.read_text()
LEFT_OUT = re.compile(r"^# (\w+ = .*|\[\[.*\]\].*)$", re.MULTILINE)
"""A key without a default stands there as a comment; so does a whole table of a list."""
TABLES_LEFT_OUT = tuple(re.findall(r"^# \[\[(.*)\]\]", TEXT, re.MULTILINE))

WRITTEN = tomllib.loads(TEXT)
WHOLE = tomllib.loads(LEFT_OUT.sub(r"\1", TEXT))
CHOSEN_FOR_THE_EXAMPLE = {
    f"camera.{role}.{key}" for role in ("main", "sub") for key in ("backend", "serial")
}
"""Not required by every command, so the model has no default; the example shows a real site."""


def flatten(tables: dict[str, Any], above: str = "") -> dict[str, Any]:
    keys: dict[str, Any] = {}
    for name, value in tables.items():
        table = (
            value[0] if isinstance(value, list) and value and isinstance(value[0], dict) else value
        )
        if isinstance(table, dict):
            keys |= flatten(table, f"{above}{name}.")
        else:
            keys[f"{above}{name}"] = value
    return keys


def model_defaults(model: type[BaseModel], above: str = "") -> dict[str, Any]:
    """Dotted key to default; PydanticUndefined where the user must say."""
    keys: dict[str, Any] = {}
    for name, field in model.model_fields.items():
        dotted = f"{above}{field.alias or name}"
        inner = [
            part
            for part in (field.annotation, *get_args(field.annotation))
            if isinstance(part, type) and issubclass(part, BaseModel)
        ]
        if inner:
            keys |= model_defaults(inner[0], f"{dotted}.")
        else:
            keys[dotted] = field.get_default(call_default_factory=True)
    return keys


DEFAULTS = model_defaults(Config)


def test_example_is_a_config_as_it_stands() -> None:
    assert load_config(EXAMPLE).name == "pier-3"


def test_example_shows_every_key_and_no_other() -> None:
    assert set(flatten(WHOLE)) == set(DEFAULTS)


def test_example_states_every_default() -> None:
    written, whole = flatten(WRITTEN), flatten(WHOLE)
    for key, default in DEFAULTS.items():
        if default is PydanticUndefined or key in CHOSEN_FOR_THE_EXAMPLE:
            continue
        shown = whole.get(key) if key.startswith(TABLES_LEFT_OUT) else written.get(key)
        if shown is not None and default is None:
            continue  # an example of a key that has no default
        expected = str(default) if isinstance(default, Path) else default
        expected = list(expected) if isinstance(expected, tuple) else expected
        assert shown == expected, key
        assert type(shown) is type(expected), key


def test_example_lists_the_scenarios_that_happen_by_default() -> None:
    assert load_config(EXAMPLE).simulation == SimulationSection()


def test_example_writes_as_comments_only_what_has_no_default() -> None:
    for key in set(flatten(WHOLE)) - set(flatten(WRITTEN)):
        assert DEFAULTS[key] is None or key.startswith(TABLES_LEFT_OUT), key


def test_example_says_why_on_every_line_of_the_first_of_each_key() -> None:
    """Each key has a comment beside it or on the line above, where it appears first."""
    seen: set[str] = set()
    above = ""
    for line in TEXT.splitlines():
        found = re.match(r"^(?:# )?(\w+) = ", line)
        if found and found[1] not in seen:
            seen.add(found[1])
            assert re.search(r"\S  +# \w", line) or above.startswith("# "), line
        above = line
