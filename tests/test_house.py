"""The house holds: the layers are kept and can be broken, the core is pure, the wheel is whole."""

import ast
import io
import json
import re
import runpy
import shutil
import subprocess
import sys
import tokenize
import tomllib
import zipfile
from pathlib import Path

import pytest

from core.results import Reason
from daemon.store.records import GapCause

ROOT = Path(__file__).parents[1]
PACKAGES = ("core", "daemon", "drivers", "migrations")
OUR_SUFFIXES = {".py", ".mako", ".toml", ".xml", ".sql", ".html", ".js", ".css", ".json", ".svg"}
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())

CORE_MAY_IMPORT = {
    *("__future__", "collections", "contextlib", "dataclasses", "enum", "functools", "itertools"),
    *("math", "operator", "types", "typing"),
    *("core", "cv2", "importlib", "numba", "numpy", "scipy"),
    *("hashlib", "pickle"),  # the cache of compiled loops checks what Numba keeps
}
"""Numerics and the standard library's data types; nothing with a clock, a file or a state."""

CORE_MAY_NOT_CALL = {
    *("cv2.imread", "cv2.imreadmulti", "cv2.imwrite", "cv2.VideoCapture", "cv2.FileStorage"),
    *("cv2.imshow", "cv2.setRNGSeed", "cv2.setNumThreads"),
    *("np.load", "np.loadtxt", "np.genfromtxt", "np.fromfile", "np.save", "np.savez", "np.savetxt"),
    *("np.random.seed", "np.random.default_rng", "np.seterr"),
    *("open", "print", "input", "exec", "eval", "breakpoint"),
}

BREAKS = {
    "layers": ("core/errors.py", "import drivers.errors"),
    "order-of-core": ("core/geometry/pose.py", "import core.rig.rigid"),
    "order-of-daemon": ("daemon/store/rows/gaps.py", "import daemon.slots.runner"),
    "order-of-store": ("daemon/store/rows/gaps.py", "import daemon.store.database"),
    "order-of-drivers": ("drivers/heads/moves.py", "import drivers.sim.head_axis"),
    "core-is-pure": ("core/site.py", "import time"),
    "drivers-are-small": ("drivers/errors.py", "import sqlalchemy"),
    "migrations-stand-alone": ("migrations/__init__.py", "import daemon.store"),
    "devices-in-one-place": ("daemon/schedule.py", "import drivers.sim.world"),
    "database-in-one-package": ("daemon/schedule.py", "import sqlalchemy"),
}
"""One forbidden import for each contract."""


AT_THE_TOP = {
    *(".ci", ".gitignore", ".npmrc", "CHANGELOG.md", "LICENSE", "Makefile", "README.md"),
    *("benchmarks", "config.example.toml", "core", "daemon", "deploy", "docs", "drivers"),
    *("hatch_build.py", "migrations", "package-lock.json", "package.json", "pyproject.toml"),
    *("studies", "systemd", "tests"),
}
"""What belongs beside the README; a build or a download leaves nothing here that is kept."""


def python_files(package: str) -> list[Path]:
    """Every Python file below a top-level folder."""
    files = sorted((ROOT / package).rglob("*.py"))
    assert files, f"no code in {package}/"
    return files


def dotted(node: ast.expr) -> str:
    """`a.b.c` of an attribute chain, else an empty string."""
    parts: list[str] = []
    while isinstance(node, ast.Attribute):
        parts.append(node.attr)
        node = node.value
    return ".".join([node.id, *reversed(parts)]) if isinstance(node, ast.Name) else ""


def lint_imports(directory: Path) -> subprocess.CompletedProcess[str]:
    command = "import sys; from importlinter.cli import lint_imports as run; sys.exit(run())"
    return subprocess.run(
        [sys.executable, "-c", command], cwd=directory, capture_output=True, text=True, check=False
    )


def test_nothing_lies_at_the_top_that_does_not_belong_there() -> None:
    ignored = {line.strip("/") for line in (ROOT / ".gitignore").read_text().split()} | {".git"}
    found = {path.name for path in ROOT.iterdir() if not any(map(path.match, ignored))}
    assert found == AT_THE_TOP


def test_import_contracts_are_kept() -> None:
    """What `make check` says, said here too, so that `make test` alone is enough."""
    result = lint_imports(ROOT)
    assert result.returncode == 0, result.stdout


def test_every_import_contract_can_break(tmp_path: Path) -> None:
    """A contract that cannot fail is worth nothing."""
    contracts = PYPROJECT["tool"]["importlinter"]["contracts"]
    assert {contract["id"] for contract in contracts} == set(BREAKS)
    for package in PACKAGES:
        shutil.copytree(
            ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for file, line in BREAKS.values():
        with (tmp_path / file).open("a") as code:
            code.write(f"\n{line}\n")

    result = lint_imports(tmp_path)

    assert result.returncode == 1, result.stderr
    report = " ".join(result.stdout.split())
    for contract in contracts:
        assert f"{contract['name']} BROKEN" in report


@pytest.mark.parametrize("path", python_files("core"), ids=lambda path: path.name)
def test_core_imports_numerics_and_data_types_only(path: Path) -> None:
    imported = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            imported |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported.add((node.module or "").partition(".")[0])
    assert imported <= CORE_MAY_IMPORT


def test_the_front_door_of_core_leads_to_every_name_and_loads_no_numerics_before() -> None:
    """`from core import find_target` works; who needs a type alone does not wait for OpenCV."""
    code = (
        "import sys, core\n"
        "core.Flag\n"
        "print([name for name in ('cv2', 'numba', 'scipy') if name in sys.modules])\n"
        "print([name for name in core.__all__ if getattr(core, name).__name__ != name])\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert result.stdout.split("\n")[:2] == ["[]", "[]"]


@pytest.mark.parametrize("path", python_files("core"), ids=lambda path: path.name)
def test_core_reads_no_file_and_keeps_no_state(path: Path) -> None:
    tree = ast.parse(path.read_text())
    used = {dotted(node) for node in ast.walk(tree) if isinstance(node, (ast.Attribute, ast.Name))}
    assert not used & CORE_MAY_NOT_CALL
    assert not [node for node in ast.walk(tree) if isinstance(node, ast.Global)]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """The wheel as a user would get it."""
    directory = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(directory)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (path,) = directory.glob("dcam-*.whl")
    return zipfile.ZipFile(path)


def test_wheel_has_our_packages_and_no_other(wheel: zipfile.ZipFile) -> None:
    """The names are generic: nothing else may slip in and shadow a site's own packages."""
    folders = {name.partition("/")[0] for name in wheel.namelist()}
    assert {name for name in folders if not name.endswith(".dist-info")} == set(PACKAGES)


def test_wheel_has_every_file_of_the_packages(wheel: zipfile.ZipFile) -> None:
    """Modules, migrations with their template, the demo's site: all that the programs read."""
    names = set(wheel.namelist())
    for package in PACKAGES:
        files = [path for path in (ROOT / package).rglob("*") if path.is_file()]
        ours = {path.relative_to(ROOT).as_posix() for path in files if path.suffix in OUR_SUFFIXES}
        assert ours <= names
    assert {"migrations/env.py", "migrations/versions/0001_first_tables.py"} <= names


def test_wheel_has_what_the_page_takes_from_npm(wheel: zipfile.ZipFile) -> None:
    """In the version of the lock file, which names no host; the repository has none of it."""
    lock = (ROOT / "package-lock.json").read_text()
    version = json.loads(lock)["packages"]["node_modules/uplot"]["version"]
    vendor = "daemon/web/static/vendor"
    assert f"(v{version})" in wheel.read(f"{vendor}/uPlot.iife.min.js").decode()[:200]
    assert {f"{vendor}/uPlot.min.css", f"{vendor}/uPlot.LICENSE"} <= set(wheel.namelist())
    assert "resolved" not in lock
    kept = subprocess.run(
        ["git", "ls-files", vendor, "node_modules"], cwd=ROOT, capture_output=True, check=True
    )
    assert kept.stdout == b""


def test_wheel_gives_both_programs(wheel: zipfile.ZipFile) -> None:
    (entry_points,) = [name for name in wheel.namelist() if name.endswith("entry_points.txt")]
    text = wheel.read(entry_points).decode()
    assert "dcamd = daemon.main:main" in text
    assert "dcam-ctl = daemon.ctl:main" in text


def test_the_picture_of_the_architecture_is_that_of_the_code() -> None:
    """`make picture` draws it; packages, their order or their purpose have changed since."""
    drawing = runpy.run_path(str(ROOT / "docs/draw_architecture.py"))
    today = drawing["fingerprint"](drawing["picture_source"]())
    assert today in drawing["PICTURE"].read_text(), "run make picture"


@pytest.mark.parametrize("word", [*Reason, *GapCause])
def test_the_pier_page_explains_every_reason_and_cause(word: str) -> None:
    """Whoever reads a word in a row or a gap finds there what it means and what to do."""
    assert f"`{word}`" in (ROOT / "docs/pier.md").read_text()


@pytest.mark.parametrize("page", sorted(ROOT.glob("*.md")) + sorted((ROOT / "docs").rglob("*.md")))
def test_links_between_the_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def undocumented_constants(code: str) -> list[str]:
    """Module-level names given a number, without a docstring below or a comment at or above them.

    A comment above a block of assignments without a blank line stands for all of them, but not for
    a table of numbers further down: that has its own.
    """
    tokens = tokenize.generate_tokens(io.StringIO(code).readline)
    comments = {token.start[0] for token in tokens if token.type == tokenize.COMMENT}
    body = ast.parse(code).body
    found, block_has_comment, last_line = [], False, 0
    for node, after in zip(body, [*body[1:], None], strict=True):
        if not isinstance(node, (ast.Assign, ast.AnnAssign)):
            continue
        above = node.lineno - 1 in comments
        if node.lineno != last_line + 1 or above:
            block_has_comment = above
        last_line = node.end_lineno or node.lineno
        beside = not comments.isdisjoint(range(node.lineno, last_line + 1))
        below = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
        covered = above if is_table(node) else block_has_comment
        if has_number(node.value) and not (covered or beside or below):
            found.append(ast.unparse(node).partition(" = ")[0])
    return found


def is_table(node: ast.Assign | ast.AnnAssign) -> bool:
    """Whether one name gets several numbers; several names that get one each are no table."""
    target = node.targets[0] if isinstance(node, ast.Assign) else node.target
    return isinstance(target, ast.Name) and any(
        isinstance(part, (ast.Tuple, ast.List)) and sum(map(has_number, part.elts)) > 1
        for part in ast.walk(node.value or target)
    )


def has_number(value: ast.expr | None) -> bool:
    """Whether there is a number in an expression."""
    return value is not None and any(
        isinstance(node, ast.Constant) and type(node.value) in {int, float}
        for node in ast.walk(value)
    )


@pytest.mark.parametrize("path", python_files("core"), ids=lambda path: path.name)
def test_every_constant_of_core_says_what_it_means(path: Path) -> None:
    """A threshold, floor or factor without unit and origin can be neither trusted nor changed."""
    assert undocumented_constants(path.read_text()) == []


@pytest.mark.parametrize(
    ("code", "names"),
    [
        ("A = 1\n", ["A"]),
        ('A = 1\n"""Why."""\n', []),
        ("A = 1  # why\n", []),
        ("# why\nA = 1\nB = 2 * A\n", []),
        ("# why\nA = 1\n\nB = 2\n", ["B"]),
        ("A, B = 1.0, np.float32(2)\n", ["A, B"]),
        ("# why\nA = (1.0, 2.0)\nB = (0.5, -3e-4)\nB0, B1 = B\n", ["B"]),
        ("# why\nA = 1.0\nB = np.array([0.5, -0.1])\n", ["B"]),
        ('# why\nA = 1.0\nB = (0.5, -0.1)\n"""Why."""\n# why\nC = [1, 2]\n', []),
        ("# why\nA = 1.0\nB, C = 2.0, 3.0\n", []),
        ('A: float = 1.0\nNAME = "x"\nFLAG = True\n', ["A: float"]),
    ],
)
def test_an_undocumented_constant_is_noticed(code: str, names: list[str]) -> None:
    assert undocumented_constants(code) == names


def test_each_test_that_a_promise_names_is_there() -> None:
    """docs/promises.md; a renamed test would leave a promise that nothing holds."""
    page = (ROOT / "docs/promises.md").read_text()
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", page)
    promises = re.findall(r"^## \d", page, re.MULTILINE)
    assert len(named) > 5 * len(promises) > 0
    missing = [
        f"{path}::{name}"
        for path, name in named
        if not (ROOT / path).is_file() or f"def {name}(" not in (ROOT / path).read_text()
    ]
    assert missing == []
