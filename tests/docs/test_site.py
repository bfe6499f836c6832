"""`make docs`: the site has every page, command, key, column, reason, and asks no other machine."""

from __future__ import annotations

import html
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from core.results import Reason
from daemon.ctl import COMMANDS
from daemon.reports.slot_table import COLUMNS
from daemon.store.records import GapCause
from tests.shared import shared_directory

ROOT = Path(__file__).parents[2]
BUILD = ROOT / "docs/site/build.py"
KEY = re.compile(r"^(?:# )?(\w+) = ", re.MULTILINE)


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages, built with every warning an error: a link that leads nowhere ends it."""

    def fill(directory: Path) -> None:
        built = subprocess.run(
            [sys.executable, str(BUILD), str(directory)],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=False,
        )
        assert built.returncode == 0, built.stdout + built.stderr

    return shared_directory(tmp_path_factory, "docs-site", fill)


def page(site: Path, name: str) -> str:
    return html.unescape((site / f"{name}.html").read_text(encoding="utf-8"))


def codes(site: Path, name: str) -> set[str]:
    """What a page sets as code."""
    plain = re.sub(r"</?span[^>]*>", "", page(site, name))
    return set(re.findall(r"<code[^>]*>([^<]*)</code>", plain))


def test_every_page_of_docs_is_in_the_site_and_its_navigation(site: Path) -> None:
    index = page(site, "index")
    for source in (ROOT / "docs").rglob("*.md"):
        name = str(source.relative_to(ROOT / "docs").with_suffix(""))
        assert (site / f"{name}.html").is_file()
        assert f'href="{name}.html"' in index, f"{name} is in no navigation"


def test_every_command_is_described(site: Path) -> None:
    text = page(site, "commands")
    for command in COMMANDS:
        assert f"Usage: dcam-ctl {command} " in text
    for program in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]:
        assert f"Usage: {program} " in text


def test_every_key_of_the_config_is_described(site: Path) -> None:
    keys = set(KEY.findall((ROOT / "config.example.toml").read_text()))
    assert len(keys) > 100
    assert keys <= codes(site, "keys")


def test_every_column_reason_and_cause_is_described(site: Path) -> None:
    assert set(COLUMNS) <= codes(site, "columns")
    assert {*Reason, *GapCause} <= codes(site, "reasons")


def test_reading_a_page_asks_no_other_machine(site: Path) -> None:
    """Links that a reader may follow aside."""
    for file in site.rglob("*.html"):
        fetched = re.findall(
            r"<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)=\"(?:https?:)?//[^\"]*",
            file.read_text(),
        )
        assert fetched == [], file
    for file in site.rglob("*.css"):
        assert not re.search(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//", file.read_text()), file


def test_the_readme_names_the_way_to_the_site() -> None:
    readme = (ROOT / "README.md").read_text()
    assert "make docs" in readme
    assert "docs/start.md" in readme
