"""Each shell loads its completion file, and completes a command and one below it."""

from __future__ import annotations

import os
import pty
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.exhaustive import IS_ASKED
from tests.waiting import wait_for

ROOT = Path(__file__).parents[2]
PATH = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
TYPED = [
    ("dcam-ctl statu", "status"),
    ("dcam-ctl simulate hea", "head"),
    ("dcamd --max-s", "--max-slots"),
]
QUICK = [TYPED[0], ("dcam-ctl status --js", "--json"), *(TYPED[1:] if IS_ASKED else [])]
"""For the shells after the first: the words come from the same programs, and these answer soon."""

ZSH = """
fpath=({functions} ${{fpath:#*/(Debian|Linux|Unix|X)}})  # not what completes other programs
autoload -U compinit
compinit -u -d {directory}/dump
finish() {{ print -r -- $BUFFER > {directory}/made; mv {directory}/made {directory}/completed }}
zle -N finish
bindkey '^X' finish
"""


@pytest.fixture(scope="module")
def share(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """/usr/share of a package."""
    root = tmp_path_factory.mktemp("package")
    places = ("/usr/lib", "/usr/bin", "/usr/share", "/opt/dcam/venv")
    subprocess.run([str(ROOT / "deploy/put-files"), str(root), *places], check=True)
    return root / "usr/share"


def run(*words: str) -> str:
    done = subprocess.run(words, env=PATH, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    return done.stdout


@pytest.mark.parametrize(("typed", "word"), TYPED)
def test_bash(share: Path, typed: str, word: str) -> None:
    program, *_ = words = typed.split()
    script = f"""
        . "{share}/bash-completion/completions/{program}"
        COMP_WORDS=({typed}) COMP_CWORD={len(words) - 1}
        "$(complete -p {program} | sed 's/.*-F \\([^ ]*\\).*/\\1/')" {program}
        echo "${{COMPREPLY[*]}}"
    """
    assert run("bash", "--norc", "-c", script) == f"{word}\n"


@pytest.mark.skipif(not shutil.which("fish"), reason="fish is not installed")
@pytest.mark.parametrize(("typed", "word"), QUICK)
def test_fish(share: Path, typed: str, word: str) -> None:
    file = share / f"fish/vendor_completions.d/{typed.split(maxsplit=1)[0]}.fish"
    said = run("fish", "--no-config", "-c", f"source {file}; complete -C '{typed}'")
    assert [line.split("\t")[0] for line in said.splitlines()] == [word]


@pytest.mark.skipif(not shutil.which("zsh"), reason="zsh is not installed")
@pytest.mark.parametrize(("typed", "word"), QUICK)
def test_zsh(share: Path, tmp_path: Path, typed: str, word: str) -> None:
    """On a terminal: only there zsh completes."""
    (tmp_path / ".zshrc").write_text(
        ZSH.format(functions=share / "zsh/vendor-completions", directory=tmp_path)
    )
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        ["zsh", "-o", "no_global_rcs", "-i"],
        env={**PATH, "ZDOTDIR": str(tmp_path), "TERM": "dumb"},
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
    ) as shell:
        os.write(ours, f"{typed}\t\x18".encode())
        completed = tmp_path / "completed"
        try:
            wait_for(completed.exists, "zsh")
        finally:
            shell.kill()
            os.close(ours)
            os.close(theirs)
    assert completed.read_text().split()[-1] == word
