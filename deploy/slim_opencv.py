"""Take from OpenCV's wheel the libraries that dcam never calls: FFmpeg's, and a second OpenBLAS.

cv2 is linked to them, so that each must be there for it to load. A library of the same name and the
same symbols takes the place of each. Those of FFmpeg, for video, end the program with one line;
those of OpenBLAS go on to the OpenBLAS that SciPy has brought. Needs gcc and readelf.
"""

from __future__ import annotations

import platform
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

VIDEO = ("libavcodec", "libavformat", "libavutil", "libswscale")
ONLY_THEIRS = (
    "libswresample",
    "libvpx",
    "libcrypto",
    "libssl",
    "libdrm",
    "libgfortran",
    "libquadmath",
)
"""What nothing but those has called."""

JUMP = {"x86_64": "jmp {}@PLT", "aarch64": "b {}"}
"""A function goes on to another, whatever its arguments."""

NO_VIDEO = Path(__file__).with_name("no_video.c")


def slim_opencv(site: Path) -> int:
    """Replace libraries of cv2 in a site-packages; give bytes saved, 0 where there is no cv2."""
    libraries = site / "opencv_python_headless.libs"
    if not libraries.is_dir():
        return 0
    (cv2,) = (site / "cv2").glob("cv2*.so")
    before = _size(libraries)
    wanted = _symbols(cv2, undefined=True)
    for library in _named(libraries, VIDEO):
        _replace(library, wanted, "dcam_no_video", [NO_VIDEO])
    (blas,) = _named(libraries, ["libopenblas"])
    for theirs in site.glob("scipy.libs/libscipy_openblas-*.so"):
        _replace(blas, wanted, "scipy_{}", [theirs, f"-Wl,-rpath,$ORIGIN/../{theirs.parent.name}"])
    for library in _named(libraries, ONLY_THEIRS):
        library.unlink()
    return before - _size(libraries)


def _replace(library: Path, wanted: dict[str, str], to: str, linked: list[str | Path]) -> None:
    """Make a library of those wanted symbols that this one has; each jumps to another."""
    has = _symbols(library, undefined=False)
    names = sorted(wanted.keys() & has.keys())
    jump = JUMP[platform.machine()]
    code = [f".globl {n}\n.type {n},@function\n{n}: {jump.format(to.format(n))}" for n in names]
    versions = sorted({has[name] for name in names} - {""})
    with tempfile.TemporaryDirectory() as directory:
        jumps, map_file = Path(directory, "jumps.s"), Path(directory, "versions.map")
        jumps.write_text(
            "\n".join([*code, '.section .note.GNU-stack,"",%progbits', ""]), encoding="utf-8"
        )
        # With more than one, the linker would have to know which symbol has which.
        map_file.write_text("".join(f"{version} {{ *; }};\n" for version in versions[:1]))
        subprocess.run(
            [
                *("gcc", "-shared", "-fPIC", "-nostdlib", f"-Wl,-soname,{library.name}"),
                *([f"-Wl,--version-script={map_file}"] if versions else []),
                *("-o", library, jumps, *linked),
            ],
            check=True,
        )


def _symbols(library: Path, *, undefined: bool) -> dict[str, str]:
    """Give the names of functions that a library lacks, or has, each with its version or ""."""
    table = subprocess.run(
        ["readelf", "--dyn-syms", "--wide", library], check=True, capture_output=True, text=True
    ).stdout
    rows = (line.split() for line in table.splitlines())
    return {
        name: version.lstrip("@")
        for row in rows
        if len(row) >= 8 and row[3] == "FUNC" and (row[6] == "UND") == undefined
        for name, _, version in [row[7].partition("@")]
    }


def _named(directory: Path, beginnings: Sequence[str]) -> list[Path]:
    return [path for begin in beginnings for path in sorted(directory.glob(f"{begin}[-p]*"))]


def _size(directory: Path) -> int:
    return sum(path.stat().st_size for path in directory.iterdir())
