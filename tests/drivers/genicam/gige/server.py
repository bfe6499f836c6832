"""One GigE Vision camera on a loopback address, in a process of its own.

    python -m tests.drivers.genicam.gige.server --address 127.0.0.1 --serial 15290000 a.png b.png

serves the images one after the other, one a trigger, over real UDP. It says `ready` on stdout when
it answers, and then one line `frame N NAME` a frame. It ends when its stdin is closed, so that no
camera outlives the test that started it. Lines on stdin change its behaviour:

    lose 0.3     drop this share of the stream's packets
    late 0.4     let the next frame take this many seconds
    show b020    say `register VALUE` of an address, as 4 bytes
    put a00=0    write 4 bytes at an address, as if something else had
    edge 3       a rising edge arrives at this line (no answer)

It says `line N` when it exposes and its line N shows that: the wire is whoever reads it.
"""

from __future__ import annotations

import argparse
import ctypes
import socket
import struct
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import gi
import numpy as np
from numpy.typing import NDArray

gi.require_version("Aravis", "0.8")
from gi.repository import Aravis  # noqa: E402  (the version must be asked for first)

from tests.drivers.genicam.gige.registers import (  # noqa: E402
    EXPOSURE_ACTIVE,
    FIRE,
    HEIGHT,
    LINE_MODE,
    LINE_SOURCE,
    LINES,
    OFFSET_X,
    OFFSET_Y,
    OUTPUT,
    RISING_EDGE,
    TRIGGER_ACTIVATION,
    TRIGGER_SOURCE,
    WIDTH,
    after_power_up,
    packed,
)

GS3_XML = Path(__file__).with_name("gs3.xml")
CONTROL_PORT = 3956
"""GigE Vision 2.0, 14.1: the device's control port."""

BITS_OF_FORMAT = {0x01080001: 8, 0x01100003: 10, 0x01100005: 12, 0x01100007: 16}
FILL_PATTERN = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32, ctypes.c_uint32
)


class FakeCamera:
    """Serves images in turn; the state is shared with Aravis' camera thread."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._images = [(path.name, _read(path)) for path in options.images]
        self._period_s: float | None = options.period_s
        self._frames = 0
        self.late_s = 0.0
        self.device = Aravis.GvFakeCamera.new_full(
            options.address, options.serial, str(options.xml) if options.xml else None
        )
        self._camera = self.device.get_fake_camera()
        self._camera.set_trigger_frequency(100.0)  # how often it looks for a trigger
        self._power_up(*self._images[0][1].shape)
        self._library = _library()
        self._callback = FILL_PATTERN(self._fill)  # kept: C code holds only the address
        self._library.arv_fake_camera_set_fill_pattern(hash(self._camera), self._callback, None)

    def _power_up(self, height: int, width: int) -> None:
        """Give the state of a GS3 after power-up: automatic modes and gamma on."""
        self._write(after_power_up(width, height))

    def _write(self, registers: dict[int, int | float]) -> None:
        for address, value in registers.items():
            data = packed(value)
            for offset, (word,) in enumerate(struct.iter_unpack(">I", data)):
                self._camera.write_register(address + 4 * offset, word)

    def put(self, address: int, value: int) -> None:
        """Write what stands at an address."""
        self._write({address: value})

    def register(self, address: int) -> int:
        """What stands at an address."""
        return int(self._camera.read_register(address)[1])

    def _fill(self, buffer: int, _data: int, _exposure: int, _gain: int, pixel_format: int) -> None:
        """Copy the next image into the frame that Aravis is about to send."""
        late_s, self.late_s = self.late_s, 0.0
        time.sleep(late_s)  # a long exposure
        index = self._frames if self._period_s is None else int(time.time() // self._period_s)
        name, image = self._images[index % len(self._images)]
        left, top = self.register(OFFSET_X), self.register(OFFSET_Y)
        width, height = self.register(WIDTH), self.register(HEIGHT)
        sample = "<u2" if BITS_OF_FORMAT[pixel_format] > 8 else "u1"
        data = image[top : top + height, left : left + width].astype(sample).tobytes()
        target = self._library.arv_buffer_get_data(buffer, ctypes.byref(ctypes.c_size_t()))
        ctypes.memmove(target, data, len(data))
        _say(f"frame {self._frames} {name}")
        self._frames += 1
        for line in LINES:
            shows = self.register(LINE_SOURCE + 4 * line) == EXPOSURE_ACTIVE
            if shows and self.register(LINE_MODE + 4 * line) == OUTPUT:
                _say(f"line {line}")

    def edge(self, line: int) -> None:
        """A rising edge at a line: a trigger, if the camera listens to it."""
        listens = self.register(TRIGGER_SOURCE) == line
        if listens and self.register(TRIGGER_ACTIVATION) == RISING_EDGE:
            self._write({FIRE: 1})


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _library() -> Any:
    library = ctypes.CDLL("libaravis-0.8.so.0")
    library.arv_buffer_get_data.restype = ctypes.c_void_p
    library.arv_buffer_get_data.argtypes = [ctypes.c_void_p, ctypes.POINTER(ctypes.c_size_t)]
    # Not through GObject introspection: there the callback would be freed when the call returns.
    library.arv_fake_camera_set_fill_pattern.argtypes = [
        ctypes.c_void_p,
        FILL_PATTERN,
        ctypes.c_void_p,
    ]
    return library


def _read(path: Path) -> NDArray[Any]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2:
        sys.exit(f"{path}: not a greyscale image")
    return np.asarray(image)


def _require_free(address: str) -> None:
    """Aravis itself goes on without its control port when that is taken."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, CONTROL_PORT))
        except OSError as error:
            sys.exit(f"{address}:{CONTROL_PORT}: {error.strerror}")


def _obey(camera: FakeCamera) -> None:
    for line in sys.stdin:
        verb, value = line.split()
        if verb == "lose":
            camera.device.set_property("gvsp-lost-ratio", float(value))
        elif verb == "late":
            camera.late_s = float(value)
        elif verb == "show":
            _say(f"register {camera.register(int(value, 16))}")
            continue
        elif verb == "put":
            address, number = (int(part, 16) for part in value.split("="))
            camera.put(address, number)
        elif verb == "edge":
            camera.edge(int(value))
            continue
        else:
            sys.exit(f"{verb}: unknown command")
        _say(f"done {verb}")


def main() -> None:
    """Serve until stdin is closed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--address", default="127.0.0.1")
    parser.add_argument("--serial", required=True)
    parser.add_argument("--xml", type=Path, default=GS3_XML)
    parser.add_argument("--stock-xml", dest="xml", action="store_const", const=None)
    parser.add_argument(
        "--period-s", type=float, help="choose the image by the clock: a new one each period"
    )
    parser.add_argument("images", type=Path, nargs="+")
    options = parser.parse_args()
    _require_free(options.address)
    camera = FakeCamera(options)
    if not camera.device.is_running():
        sys.exit(f"{options.address}: the camera does not start; is it an address of this machine?")
    _say("ready")
    _obey(camera)


if __name__ == "__main__":
    main()
