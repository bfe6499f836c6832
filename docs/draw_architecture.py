"""Draw docs/images/architecture.svg from the code: `make picture` (needs Debian's graphviz).

Packages, floors and what each package is for are read from the import contracts, the imports
and the docstrings, so the picture shows what is and not what was meant. A test holds the stored
picture against the code of the day.
"""

from __future__ import annotations

import ast
import hashlib
import subprocess
import textwrap
import tomllib
from itertools import pairwise
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs/images/architecture.svg"
LAYERS = {"daemon": "#fff3d6", "drivers": "#dcebf7", "core": "#e2f0dc"}
"""Top to bottom, and the colour of their packages."""
WIDTH = 26
"""Characters in a line of a package."""


def floors(layer: str) -> list[list[str]]:
    """The floors of a layer, top to bottom: the names in each, as the contract has them."""
    config = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = config["tool"]["importlinter"]["contracts"]
    (contract,) = (c for c in contracts if c.get("containers") == [layer])
    return [[name.strip() for name in floor.split("|")] for floor in contract["layers"]]


def packages(layer: str) -> dict[str, tuple[str, ...]]:
    """What is drawn as a box: each folder, and the single modules of a floor together."""
    found: dict[str, tuple[str, ...]] = {}
    for floor in floors(layer):
        single = tuple(name for name in floor if (ROOT / layer / f"{name}.py").exists())
        for name in floor:
            if name not in single:
                found[name] = (name,)
        if single:
            found[" · ".join(single)] = single
    return found


def purpose(layer: str, package: str) -> str:
    """The first sentence of a folder's docstring."""
    file = ROOT / layer / package / "__init__.py"
    if not file.exists():
        return ""
    text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return text.split("\n\n")[0].replace("\n", " ")


def arrows(graph: grimp.ImportGraph, layer: str) -> set[tuple[str, str]]:
    """(importer, imported) packages; an arrow that follows from two others is left out."""
    of = {name: package for package, names in packages(layer).items() for name in names}
    found = set()
    for module in graph.modules:
        parts = module.split(".")
        if parts[0] != layer or len(parts) == 1:
            continue
        for imported in graph.find_modules_directly_imported_by(module):
            there = imported.split(".")
            if there[0] == layer and len(there) > 1 and of[parts[1]] != of[there[1]]:
                found.add((of[parts[1]], of[there[1]]))
    reach = {a: {b for x, b in found if x == a} for a, _ in found}

    def reaches(a: str, b: str) -> bool:
        return any(next_ == b or reaches(next_, b) for next_ in reach.get(a, ()))

    return {(a, b) for a, b in found if not any(c != b and reaches(c, b) for c in reach[a])}


def label(layer: str, package: str) -> str:
    """The package's name in bold and what it is for."""
    lines = textwrap.wrap(purpose(layer, package), WIDTH)
    if not lines:
        return "<" + "<br/>".join(textwrap.wrap(package, WIDTH + 6)) + ">"
    return f"<<b>{package}</b><br/>" + "<br/>".join(lines) + ">"


def picture_source() -> str:
    """The picture in Graphviz's language; the same for the same code."""
    graph = grimp.build_graph(*LAYERS, cache_dir=None)
    out = [
        "digraph dcam {",
        'node [shape=box style="filled,rounded" fontname="Helvetica" fontsize=10]',
        'graph [fontname="Helvetica" fontsize=13 nodesep=0.18 ranksep=0.3 compound=true]',
        'edge [color="#00000060" arrowsize=0.6]',
    ]
    for layer, colour in LAYERS.items():
        out.append(f'subgraph cluster_{layer} {{ label="{layer}/" style=rounded color=gray')
        boxes = packages(layer)
        out += [
            f'"{layer}/{package}" [label={label(layer, package)} fillcolor="{colour}"]'
            for package in boxes
        ]
        for floor in floors(layer):
            here = [package for package, names in boxes.items() if set(names) & set(floor)]
            out.append("{ rank=same " + " ".join(f'"{layer}/{package}"' for package in here) + " }")
        tops = [next(r for r, n in boxes.items() if set(n) & set(f)) for f in floors(layer)]
        out += [f'"{layer}/{a}" -> "{layer}/{b}" [style=invis weight=9]' for a, b in pairwise(tops)]
        out += [f'"{layer}/{a}" -> "{layer}/{b}"' for a, b in sorted(arrows(graph, layer))]
        out.append("}")
    out.append("}")
    return "\n".join(out) + "\n"


def fingerprint(source: str) -> str:
    """What the stored picture carries of the code that it was drawn from."""
    return hashlib.sha256(source.encode()).hexdigest()


def main() -> None:
    """Draw and store the picture."""
    source = picture_source()
    svg = subprocess.run(
        ["dot", "-Tsvg"],  # noqa: S607 - Debian's graphviz, wherever it is installed
        input=source,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    PICTURE.write_text(f"{svg}<!-- drawn from {fingerprint(source)} -->\n", encoding="utf-8")


if __name__ == "__main__":
    main()
