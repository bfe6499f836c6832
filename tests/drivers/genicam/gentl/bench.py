"""GenTL producers for the tests: ours over libaravis, and the one that `genicam` carries."""

from __future__ import annotations

import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

from tests.drivers.genicam.building import built

SOURCE = Path(__file__).with_name("producer.c")
GS3_XML = Path(__file__).parents[1] / "gige/gs3.xml"
INCLUDES = Path("/usr/include/aravis-0.8")


@functools.cache
def producer(habit: str | None = None) -> Path:
    """Build the producer, with one of the habits named in its source, once.

    Skips, with what is missing, where that cannot be done.
    """
    for tool in ("gcc", "pkg-config"):
        if shutil.which(tool) is None:
            pytest.skip(f"GenTL producer: no {tool}; apt-get install gcc pkg-config libaravis-dev")
    if not INCLUDES.is_dir():
        pytest.skip("GenTL producer: no Aravis headers; apt-get install libaravis-dev")
    # Not Aravis' own .pc: it asks for those of libusb and others, which its headers do not need.
    glib = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "gio-2.0", "gobject-2.0"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    options = ["-Wl,-z,nodelete", "-I", str(INCLUDES), *glib, "-laravis-0.8"]
    return built(SOURCE, "producer.cti", [f"-D{habit}", *options] if habit else options)


@functools.cache
def genapi_xml() -> Path:
    """The GS3's description as GenApi takes it.

    There TriggerSource is as writable as it is in truth; that it is not is a belief of Aravis.
    """
    text = GS3_XML.read_text()
    changed = text.replace("<ImposedAccessMode>RO</ImposedAccessMode>", "")
    assert changed != text
    path = Path(tempfile.mkdtemp(prefix="dcam-gentl-")) / "gs3.xml"
    path.write_text(changed)
    return path


def faulty(folder: Path, *, crashes: bool) -> Path:
    """Build a producer that hangs, or crashes, in its first call."""
    if shutil.which("gcc") is None:
        pytest.skip("GenTL producer: no gcc; apt-get install gcc")
    library = folder / "faulty.cti"
    options = ["-shared", "-fPIC", *(["-DCRASHES"] if crashes else [])]
    subprocess.run(["gcc", *options, SOURCE.with_name("faulty.c"), "-o", library], check=True)
    return library


def viky() -> Path:
    """The producer that the genicam package carries: cameras without trigger and exposure."""
    genicam = pytest.importorskip("genicam", exc_type=ImportError)
    return Path(genicam.__file__).parent / "viky.cti"
