"""One USB3 Vision camera behind a Unix socket, in a process of its own; `libusb.c` is the bus.

    python -m tests.drivers.genicam.usb3.server --port 1.usb --serial 15290000 a.png b.png

serves the images one after the other, one a trigger, in the words of U3V: commands that read and
write memory, then leader, payload and trailer of each frame. It is driven as the GigE camera
(`tests.drivers.genicam.gige.server`) and has the same registers. Lines on stdin:

    lose 0.3     send half of the payload of this share of the frames
    skip         send nothing of the next frame's payload, so that the stream is out of step
    late 0.4     let the next frame take this many seconds
    show b020    say `register VALUE` of an address, as 4 bytes
    edge 3       a rising edge arrives at this line (no answer)
    fault NAME   from now on: `duplicate` (each frame twice), `swapped` (bytes of a 16-bit pixel),
                 `clock-back` (its time starts again each second), `stalled` (commands are not
                 answered), `denied` (may not be opened), `busy` (another program has
                 it); `none` ends it
    power-cut    lose all state and every connection, be back at once
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import socket
import struct
import sys
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tests.drivers.genicam.gige import registers

GS3_XML = Path(__file__).parents[1] / "gige/gs3.xml"

# Where things are: by GenCP 1.3, by gs3.xml, and as this camera likes.
MANUFACTURER, RESPONSE_MS, MANIFEST_AT, SBRM_AT = 0x04, 0x1CC, 0x1D0, 0x1D8
VENDOR, MODEL, SERIAL = 0x48, 0x68, 0xD8
SBRM, SIRM, MANIFEST, XML = 0x10000, 0x20000, 0x40000, 0x50000
STREAM_CONTROL, PAYLOAD_SIZE, TRANSFER_SIZE = SIRM + 0x04, SIRM + 0x08, SIRM + 0x1C
MEMORY_BYTES = 1 << 20
READ, WRITE = 0x0800, 0x0802
LEADER_BYTES, TRAILER_BYTES = 52, 32
CHUNK_ACTIVE, CHUNK_BYTES = 0xB100, 24
IMAGE, EXTENDED_CHUNK = 0x0001, 0x4001
ACQUISITION, TRIGGER_MODE = 0x124, 0x300
TICK_NS = 125_000
NO_SUCH_ADDRESS = 0x8003
ACCESS, BUSY = -3, -6
"""Errors of libusb."""


class Camera:
    """Memory, state and connections; one lock around all of it."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self._images = [(path.name, _read(path)) for path in options.images]
        self._lock = threading.RLock()
        self._fired = threading.Condition(self._lock)
        self._streams: dict[bytes, socket.socket] = {}
        self._controls: dict[bytes, socket.socket] = {}
        self._owner: bytes | None = None
        self._epoch = 1
        self._shown = 0
        self.fault = "none"
        self.lose = 0.0
        self.skip = False
        self.late_s = 0.0
        self.power_up()
        threading.Thread(target=self._expose, daemon=True).start()

    def power_up(self) -> None:
        """Give the state of a GS3 after power-up: automatic modes and gamma on."""
        with self._lock:
            self._memory = bytearray(MEMORY_BYTES)
            self._frame_id, self._triggers, self._since_ns = 0, 0, time.monotonic_ns()
            xml = self._options.xml.read_bytes()
            for address in (MANUFACTURER, VENDOR):
                self._put(address, b"Point Grey Research")
            self._put(MODEL, b"GS3-U3-23S6M")
            self._put(SERIAL, self._options.serial.encode())
            self._put(XML, xml)
            for address, number in ((MANIFEST_AT, MANIFEST), (SBRM_AT, SBRM), (SBRM + 0x20, SIRM)):
                self._put(address, struct.pack("<Q", number))
            self._put(MANIFEST, struct.pack("<QQQQ", 1, 0, XML, len(xml)))
            self._put(RESPONSE_MS, struct.pack("<I", 200))
            self._put(SBRM + 0x14, struct.pack("<III", 1024, 1024, 1))
            self._put(SIRM + 0x10, struct.pack("<II", LEADER_BYTES, TRAILER_BYTES))
            height, width = self._images[0][1].shape
            for address, value in registers.after_power_up(width, height).items():
                self._put(address, registers.packed(value))
            for address, value in self._options.left:
                self._put(address, struct.pack(">I", value))

    def register(self, address: int) -> int:
        """What stands at an address, as GenICam reads it."""
        return int.from_bytes(self._memory[address : address + 4], "big")

    def edge(self, line: int) -> None:
        """A rising edge at a line: a trigger, if the camera listens to it."""
        with self._lock:
            listens = self.register(registers.TRIGGER_SOURCE) == line
            if listens and self.register(registers.TRIGGER_ACTIVATION) == registers.RISING_EDGE:
                self._trigger()

    def power_cut(self) -> None:
        """Lose all state and every connection."""
        with self._lock:
            for connection in (*self._controls.values(), *self._streams.values()):
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
            self.power_up()

    # ------------------------------------------------------------ connections

    def serve(self, connection: socket.socket) -> None:
        """Serve one connection until its other end goes: control, or the stream of a handle."""
        with connection, contextlib.suppress(EOFError, OSError):
            kind = _exactly(connection, 1)
            handle = _exactly(connection, 16)
            if kind == b"S":
                self._streams[handle] = connection
                connection.recv(1)  # nothing comes but the end
                return
            self._controls[handle] = connection
            status = ACCESS if self.fault == "denied" else 0
            name = f"{int(self._options.serial):08X}".encode()
            connection.sendall(struct.pack("<i32s32s", status, name, b"1E10" + name))
            try:
                while True:
                    length, _ = struct.unpack("<II", _exactly(connection, 8))
                    answer = self._answer(handle, _exactly(connection, length))
                    if answer is not None:
                        connection.sendall(struct.pack("<II", len(answer), self._epoch) + answer)
            finally:
                self._forget(handle)

    def _forget(self, handle: bytes) -> None:
        with self._lock:
            self._controls.pop(handle, None)
            self._streams.pop(handle, None)
            if self._owner == handle:
                self._owner = None
                self._put(STREAM_CONTROL, bytes(4))

    def _answer(self, handle: bytes, request: bytes) -> bytes | None:
        if request in {b"claim", b"release"}:
            with self._lock:
                free = self._owner in {None, handle} and self.fault != "busy"
                if free:
                    self._owner = handle if request == b"claim" else None
            return struct.pack("<i", 0 if free else BUSY)
        if self.fault == "stalled":
            return None
        command, _, number = struct.unpack_from("<HHH", request, 6)
        (address,) = struct.unpack_from("<Q", request, 12)
        with self._lock:
            if command == READ:
                (size,) = struct.unpack_from("<H", request, 22)
                self._put(PAYLOAD_SIZE, struct.pack("<Q", self._payload_bytes()))
                body = bytes(self._memory[address : address + size])
            else:
                size = len(request) - 20
                body = struct.pack("<HH", 0, size)
            status = 0 if address + size <= MEMORY_BYTES else NO_SUCH_ADDRESS
            if command == WRITE and not status:
                self._write(address, request[20:])
        return struct.pack("<4sHHHH", b"U3VC", status, command + 1, len(body), number) + body

    def _write(self, address: int, data: bytes) -> None:
        self._put(address, data)
        if address == STREAM_CONTROL:
            self._epoch += 1
        software = self.register(registers.TRIGGER_SOURCE) == registers.SOFTWARE
        if address == registers.FIRE and software:
            self._trigger()

    def _put(self, address: int, data: bytes) -> None:
        self._memory[address : address + len(data)] = data

    def _trigger(self) -> None:
        if self.register(ACQUISITION) == 1 and self.register(TRIGGER_MODE) == 1:
            self._triggers += 1
            self._fired.notify()

    # ------------------------------------------------------------ frames

    def _image_bytes(self) -> int:
        bits = self.register(registers.PIXEL_FORMAT) >> 16 & 0xFF
        return self.register(registers.WIDTH) * self.register(registers.HEIGHT) * bits // 8

    def _payload_bytes(self) -> int:
        chunk = CHUNK_BYTES if self.register(CHUNK_ACTIVE) else 0
        return self._image_bytes() + chunk

    def _expose(self) -> None:
        while True:
            with self._lock:
                self._fired.wait_for(lambda: self._triggers > 0)
                self._triggers -= 1
                late_s, self.late_s = self.late_s, 0.0
                epoch, time_ns = self._epoch, self._now_ns()
                frame_id, self._frame_id = self._frame_id, self._frame_id + 1
                packets = self._frame(frame_id, time_ns)
                stream = self._streams.get(self._owner or b"")
                running = self._memory[STREAM_CONTROL] == 1
            time.sleep(late_s)  # a long exposure
            times = 2 if self.fault == "duplicate" else 1
            if running and stream is not None:
                for packet in packets * times:
                    with contextlib.suppress(OSError):
                        stream.sendall(struct.pack("<II", len(packet), epoch) + packet)

    def _now_ns(self) -> int:
        now_ns = (time.monotonic_ns() - self._since_ns) // TICK_NS * TICK_NS
        return now_ns % 10**9 if self.fault == "clock-back" else now_ns

    def _frame(self, frame_id: int, time_ns: int) -> list[bytes]:
        period_s = self._options.period_s
        index = self._shown if period_s is None else int(time.time() // period_s)
        name, image = self._images[index % len(self._images)]
        self._shown += 1
        left, top = self.register(registers.OFFSET_X), self.register(registers.OFFSET_Y)
        width, height = self.register(registers.WIDTH), self.register(registers.HEIGHT)
        pixel_format = self.register(registers.PIXEL_FORMAT)
        deep = pixel_format >> 16 & 0xFF == 16
        sample = "u1" if not deep else ">u2" if self.fault == "swapped" else "<u2"
        pixels = image[top : top + height, left : left + width].astype(sample).tobytes()
        chunk = bytes(self._payload_bytes() - len(pixels))
        payload = pixels + chunk
        kind = EXTENDED_CHUNK if chunk else IMAGE
        leader = struct.pack("<4sHHQHHQ", b"U3VL", 0, LEADER_BYTES, frame_id, 0, kind, time_ns)
        leader += struct.pack("<IIIIIHH", pixel_format, width, height, left, top, 0, 0)
        trailer = struct.pack("<4sHHQHHQ", b"U3VT", 0, TRAILER_BYTES, frame_id, 0, 0, len(payload))
        trailer += struct.pack("<I", height)
        _say(f"frame {frame_id} {name}")
        for line in registers.LINES:
            shows = self.register(registers.LINE_SOURCE + 4 * line) == registers.EXPOSURE_ACTIVE
            if shows and self.register(registers.LINE_MODE + 4 * line) == registers.OUTPUT:
                _say(f"line {line}")
        lost = random.random() < self.lose
        skipped, self.skip = self.skip, False
        (step,) = struct.unpack_from("<I", self._memory, TRANSFER_SIZE)
        if lost:
            payload = payload[: len(payload) // 2]
        parts = [payload[at : at + step] for at in range(0, len(payload), step or len(payload))]
        return [leader, *([] if skipped else parts), trailer]


def _exactly(connection: socket.socket, n: int) -> bytes:
    data = b""
    while len(data) < n:
        part = connection.recv(n - len(data))
        if not part:
            raise EOFError
        data += part
    return data


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def _read(path: Path) -> NDArray[Any]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None or image.ndim != 2:
        sys.exit(f"{path}: not a greyscale image")
    return np.asarray(image)


def _accept(bus: socket.socket, camera: Camera) -> None:
    while True:
        connection, _ = bus.accept()
        threading.Thread(target=camera.serve, args=(connection,), daemon=True).start()


def _obey(camera: Camera) -> None:
    for line in sys.stdin:
        verb, *values = line.split()
        if verb == "lose":
            camera.lose = float(values[0])
        elif verb == "skip":
            camera.skip = True
        elif verb == "late":
            camera.late_s = float(values[0])
        elif verb == "fault":
            camera.fault = values[0]
        elif verb == "power-cut":
            camera.power_cut()
        elif verb == "show":
            _say(f"register {camera.register(int(values[0], 16))}")
            continue
        elif verb == "edge":
            camera.edge(int(values[0]))
            continue
        else:
            sys.exit(f"{verb}: unknown command")
        _say(f"done {verb}")


def _left(text: str) -> tuple[int, int]:
    address, value = text.split("=")
    return int(address, 16), int(value, 16)


def main() -> None:
    """Serve until stdin is closed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--port", type=Path, required=True)
    parser.add_argument("--serial", required=True)
    parser.add_argument("--xml", type=Path, default=GS3_XML)
    parser.add_argument(
        "--left", type=_left, action="append", default=[], help="ADDRESS=VALUE after power-up"
    )
    parser.add_argument(
        "--period-s", type=float, help="choose the image by the clock: a new one each period"
    )
    parser.add_argument("images", type=Path, nargs="+")
    options = parser.parse_args()
    camera = Camera(options)
    with contextlib.suppress(FileNotFoundError):
        options.port.unlink()  # of a camera that was killed
    with socket.socket(socket.AF_UNIX) as bus:
        bus.bind(str(options.port))
        bus.listen(16)
        threading.Thread(target=_accept, args=(bus, camera), daemon=True).start()
        _say("ready")
        _obey(camera)
    os._exit(0)  # whatever its threads wait for


if __name__ == "__main__":
    main()
