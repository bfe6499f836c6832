#!/usr/bin/env python3
"""Take out of an environment what dcam never uses, and list the modules that it does load.

Use: ENVIRONMENT/bin/python3 trim_venv.py [--libraries]
What goes, and why, stands here: CUTS, and with --libraries also symbol tables and what
slim_opencv.py says; for those gcc, readelf and eu-strip (elfutils) are needed. Licences stay. A
library that then no longer loads ends this with its name.
"""

from __future__ import annotations

import ast
import contextlib
import gc
import importlib
import shutil
import subprocess
import sys
import sysconfig
import warnings
from collections.abc import Iterator
from pathlib import Path

from slim_opencv import slim_opencv

SITE = Path(sysconfig.get_path("purelib"))
OURS = ("core", "drivers", "daemon", "migrations")
LOADED = Path(sys.prefix) / "loaded-modules"
"""Files below sys.prefix, a line each: those that byte code is made for. Byte code of all modules
would be two and a half times as much."""

CUTS = {
    "tests of other projects, with their data: they ran where the wheel was made": [
        *("**/tests", "sqlalchemy/testing", "alembic/testing", "matplotlib/testing"),
        *("harvesters/test", "numpy/_core/_*_tests.*.so", "numpy/_core/_simd.*.so"),
    ],
    "sources and headers of what is compiled, and types: nothing is compiled against them here": [
        f"**/*.{ending}" for ending in ("c", "h", "cpp", "hpp", "pyx", "pxd", "pxi", "pyi", "f90")
    ],
    "numba on graphics cards, and with Intel's threads, which are not installed": [
        *("numba/cuda", "numba/np/ufunc/tbbpool.*.so"),
    ],
    "matplotlib's example data, and PostScript's names of fonts": [
        "matplotlib/mpl-data/sample_data",
        *(f"matplotlib/mpl-data/fonts/{name}" for name in ("afm", "pdfcorefonts")),
    ],
    "reportlab's PostScript fonts: our pages use those that every PDF reader has": [
        *("reportlab/fonts/*.pfb", "reportlab/fonts/*.sfd"),
    ],
    "AVIF pictures: ours are PNG, JPEG, SVG and PDF": ["PIL/_avif.*.so", "pillow.libs/libavif-*"],
    "time zones: Debian's tzdata has them": ["tzdata", "tzdata-*.dist-info"],
}

LOADED_BY_NAME = [
    *(f"matplotlib.backends.backend_{name}" for name in ("agg", "pdf", "svg")),
    *("sqlalchemy.dialects.sqlite", "click.shell_completion", "PIL.PngImagePlugin"),
    *("sqlalchemy.dialects.postgresql.psycopg", "psycopg_binary"),
    *("sqlalchemy.dialects.postgresql.psycopg", "psycopg_binary"),
    *("apprise.plugins", "reportlab.graphics.renderPDF", "numba.core.typed_passes"),
]
"""What libraries load themselves, by a name that they put together."""

LOAD_ALL = """
import ctypes, os, sys
failed = False
for path in sys.argv[1:]:
    try:
        ctypes.CDLL(path)
    except OSError as error:
        failed = True
        print(path, error, flush=True)
os._exit(failed)  # ends nothing of what was loaded: much of it was never begun
"""


def cut() -> int:
    """Remove what CUTS names; give bytes."""
    gone = 0
    for pattern in (pattern for patterns in CUTS.values() for pattern in patterns):
        for path in sorted(SITE.glob(pattern)):
            if not path.exists() or path.relative_to(SITE).parts[0] in OURS:
                continue
            files = path.rglob("*") if path.is_dir() else [path]
            gone += sum(file.stat().st_size for file in files if file.is_file())
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    return gone


def strip() -> int:
    """Take symbol tables out of libraries and try to load each; give bytes."""
    libraries = [
        path
        for path in sorted(SITE.rglob("*.so*"))
        if path.is_file() and path.read_bytes()[:4] == b"\x7fELF"
    ]
    before = sum(path.stat().st_size for path in libraries)
    for library in libraries:
        # Not binutils' strip: it moves segments, which what patchelf has edited does not survive.
        subprocess.run(["eu-strip", library], check=True)
    tried = subprocess.run(
        [sys.executable, "-c", LOAD_ALL, *libraries], capture_output=True, text=True, check=False
    )
    if tried.returncode:
        sys.exit(f"dcam: stripped, a library does not load:\n{tried.stdout}{tried.stderr}")
    return before - sum(path.stat().st_size for path in libraries)


def imports() -> Iterator[str]:
    """Names of all modules of ours, and all that they import, wherever in the file."""
    for ours in OURS:
        for path in sorted((SITE / ours).rglob("*.py")):
            name = ".".join(path.relative_to(SITE).with_suffix("").parts)
            yield name.removesuffix(".__init__")
            for node in statements(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Import):
                    yield from (alias.name for alias in node.names)
                elif isinstance(node, ast.ImportFrom) and node.module:
                    yield node.module
                    yield from (f"{node.module}.{alias.name}" for alias in node.names)


def statements(tree: ast.AST) -> Iterator[ast.AST]:
    """All statements below a module's or another's, which are a tenth of its nodes."""
    for field in ("body", "handlers", "orelse", "finalbody", "cases"):
        for node in getattr(tree, field, []):
            yield node
            yield from statements(node)


def list_loaded() -> None:
    """Write LOADED: what importing all of that leaves in memory, and every module of ours."""
    warnings.simplefilter("ignore")
    sys.dont_write_bytecode = True
    gc.disable()  # of all that is loaded nothing becomes garbage
    for name in [*dict.fromkeys(imports()), *LOADED_BY_NAME]:
        # Not a module but a name in one, or of a library that is not there: nothing to compile. A
        # module of ours then fails at once for the next that needs it; one ends its process.
        try:
            importlib.import_module(name)
        except (Exception, SystemExit):  # noqa: BLE001 - whatever it raises
            if name.partition(".")[0] in OURS:
                sys.modules.setdefault(name, None)
    with contextlib.suppress(ModuleNotFoundError):  # loads its hundred receivers at its first use
        importlib.import_module("apprise").Apprise().add("json://localhost")
    files = {path for ours in OURS for path in (SITE / ours).rglob("*.py")}
    files |= {Path(module.__file__ or "") for module in sys.modules.values() if is_file(module)}
    inside = [file for file in sorted(files) if file.suffix == ".py" and file.is_relative_to(SITE)]
    LOADED.write_text("".join(f"{file.relative_to(sys.prefix)}\n" for file in inside))


def is_file(module: object) -> bool:
    """Whether a module was read from a file; some put objects of their own into sys.modules."""
    return isinstance(getattr(module, "__file__", None), str)


def main() -> None:
    """Cut, work on the libraries if asked, list."""
    gone = cut()
    if "--libraries" in sys.argv[1:]:
        gone += slim_opencv(SITE) + strip()
    list_loaded()
    print(f"dcam: {gone / 1e6:.0f} MB that are not used taken out of the environment")


if __name__ == "__main__":
    main()
