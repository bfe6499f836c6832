"""The examples in core's docstrings and in docs/functions.md run, and give what they say."""

from __future__ import annotations

import doctest
import importlib
import inspect
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import core
from core.images import GreyImage
from drivers.png import encode_png
from tests.core.scenes import MINUTE
from tests.core.sessions import Session
from tests.core.targets import TargetScene

ROOT = Path(__file__).parents[2]
MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in sorted((ROOT / "core").rglob("*.py"))
]
FRONT_DOOR = [name for name in core.__all__ if name[0].islower()]


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_give_what_they_say(name: str) -> None:
    module = importlib.import_module(name)
    runner = doctest.DocTestRunner()
    report: list[str] = []
    for test in doctest.DocTestFinder().find(module):
        runner.run(test, out=report.append)
    assert not runner.summarize(verbose=False).failed, "".join(report)


def test_examples_of_compiled_functions_are_found() -> None:
    found = doctest.DocTestFinder().find(importlib.import_module("core.grey_fit"))
    assert [test.name for test in found if test.examples and test.name.endswith("solve_spd")]


@pytest.mark.parametrize("name", FRONT_DOOR)
def test_every_function_at_the_front_door_has_an_example(name: str) -> None:
    """In its docstring, or in docs/functions.md, whose code runs below."""
    in_docstring = ">>>" in (inspect.getdoc(getattr(core, name)) or "")
    assert in_docstring or f"{name}(" in (ROOT / "docs/functions.md").read_text()


@pytest.fixture
def images(tmp_path: Path, quick: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """What docs/functions.md reads: a plate, a board in ten ways, the views of a small site."""
    scene = TargetScene()
    files = {"plate": scene.image()}
    files |= {f"view{k}": GreyImage(board_image(*HELD[k])) for k in range(len(HELD))}
    files |= {f"lens{k}": view.sub for k, view in enumerate(quick.views[:5])}
    for k, view in enumerate(quick.views[5:12]):
        files |= {f"main{k}": view.main, f"sub{k}": view.sub}
    files["main7"], files["sub7"] = quick.pair(quick.world.settings.start_utc + 60 * MINUTE)
    for name, image in files.items():
        (tmp_path / f"{name}.png").write_bytes(encode_png(image.pixels, image.bits))
    monkeypatch.chdir(tmp_path)


def board_image(turn_rad: tuple[float, float, float], middle_mm: tuple[float, float, float]):
    """A board of 10 x 7 squares of 30 mm as a camera of 640 x 480 px and f = 535 px sees it."""
    squares = np.pad(np.indices((7, 10)).sum(axis=0) % 2, 1, constant_values=1)
    print_px = np.kron(squares * 170.0 + 30.0, np.ones((60, 60))).astype(np.uint8)
    to_mm = np.array([[0.5, 0.0, -29.75], [0.0, 0.5, -29.75], [0.0, 0.0, 1.0]])
    R = Rotation.from_rotvec(turn_rad).as_matrix()
    t_mm = np.array(middle_mm) - R @ np.array([150.0, 105.0, 0.0])
    camera = np.array([[535.0, 0.0, 322.0], [0.0, 535.0, 236.0], [0.0, 0.0, 1.0]])
    larger = np.array([[4.0, 0.0, 1.5], [0.0, 4.0, 1.5], [0.0, 0.0, 1.0]])
    H = larger @ camera @ np.column_stack([R[:, 0], R[:, 1], t_mm]) @ to_mm
    fine = cv2.warpPerspective(print_px, H, (2560, 1920), borderValue=200)
    clear = cv2.resize(fine, (640, 480), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(1).normal(0.0, 1.0, clear.shape)
    return np.rint(clear + noise).astype(np.uint8)


HELD = [
    ((0.4, 0.0, 0.0), (0.0, 0.0, 420.0)),
    ((-0.4, 0.0, 0.1), (40.0, 20.0, 430.0)),
    ((0.0, 0.4, 0.0), (-40.0, 20.0, 420.0)),
    ((0.0, -0.4, 0.1), (40.0, -20.0, 410.0)),
    ((0.3, 0.3, 0.0), (-40.0, -20.0, 430.0)),
    ((-0.3, 0.3, 0.2), (0.0, 30.0, 450.0)),
    ((0.3, -0.3, -0.1), (60.0, 0.0, 480.0)),
    ((-0.3, -0.3, 0.0), (-60.0, 0.0, 480.0)),
    ((0.2, 0.0, -0.2), (0.0, -30.0, 460.0)),
    ((0.0, 0.2, 0.2), (20.0, 10.0, 400.0)),
]
"""How the board is held: rotation vector, and place of its middle before the camera, mm."""


@pytest.mark.usefixtures("images")
def test_the_code_of_docs_functions_runs_and_finds_what_is_there() -> None:
    """All blocks, one after another, as a reader would type them."""
    names: dict[str, Any] = {}
    page = (ROOT / "docs/functions.md").read_text()
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, names)
    assert names["found"].lens.parameters[[0, 1]] == pytest.approx([535.0, 535.0], rel=0.01)
    assert names["report"].passed
    assert names["row"].corrected is not None
