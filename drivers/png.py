"""Greyscale PNG: what is decoded is whole and undamaged, bit depth included."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import cast

import cv2
import numpy as np

from core.images import GreyImage
from drivers.protocols import Image

MOST_PIXELS = 200_000_000
"""Not decoded beyond that: the largest sensors (Sony IMX411, 2018) have 151 million pixels."""

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_KINDS = {0: "greyscale", 2: "colour", 3: "palette", 4: "greyscale with alpha", 6: "colour"}


def decode_png(data: bytes) -> GreyImage:
    """Decode a greyscale PNG. Raises ValueError: what is wrong with it, and what to do.

    OpenCV gives a partly grey picture for a truncated file, without an error; so every chunk's
    checksum is verified first, up to the end mark (ISO/IEC 15948, 5.3).
    """
    depth, significant = _verify_png(data)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.ndim != 2 or pixels.dtype not in (np.uint8, np.uint16):
        msg = "cannot be decoded as a greyscale PNG; restore it from the original"
        raise ValueError(msg)
    return GreyImage(cast("Image", pixels), min(significant or depth, depth))


def _verify_png(data: bytes) -> tuple[int, int | None]:
    """Check every byte of a PNG by its checksums; give bit depth and significant bits (sBIT)."""
    if not data:
        msg = "an empty file (0 bytes); restore the image"
        raise ValueError(msg)
    if not data.startswith(_SIGNATURE):
        msg = "not a PNG file; frame sets hold greyscale PNG images"
        raise ValueError(msg)
    depth, significant = 0, None
    for name, body in _chunks(data):
        if name == b"IHDR" and len(body) == 13:
            depth, kind = body[8], body[9]
            width, height = struct.unpack_from(">2I", body)
            if width * height > MOST_PIXELS:
                msg = f"{width}x{height} px, larger than any camera's image: take the file away"
                raise ValueError(msg)
            if kind != 0:
                msg = f"a {_KINDS.get(kind, 'strange')} image; store it as 8- or 16-bit greyscale"
                raise ValueError(msg)
            if depth not in (8, 16):
                msg = f"{depth} bits a pixel; store it as 8- or 16-bit greyscale"
                raise ValueError(msg)
        elif name == b"sBIT" and len(body) == 1:
            significant = body[0] or None
    if not depth:
        msg = "damaged: no image header; restore it from the original"
        raise ValueError(msg)
    return depth, significant


def _chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Give the chunks up to IEND, each verified. Raises ValueError on truncation or damage."""
    view = memoryview(data)
    at = len(_SIGNATURE)
    name = b""
    while name != b"IEND":
        if at + 12 > len(data):
            break
        length, name = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data):
            break
        (checksum,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(view[at + 4 : end - 4]) != checksum:
            msg = f"damaged: wrong checksum at byte {at}; restore it from the original"
            raise ValueError(msg)
        yield name, view[at + 8 : end - 4]
        at = end
    else:
        return
    msg = f"truncated after {len(data)} bytes; restore it from the original"
    raise ValueError(msg)


def encode_png(pixels: Image, bits: int | None = None) -> bytes:
    """Encode a greyscale image losslessly; fewer significant bits are noted in the file (sBIT)."""
    ok, buffer = cv2.imencode(".png", pixels)
    if not ok:  # OpenCV raises for arrays it cannot encode; this is its word on anything else
        msg = f"OpenCV could not encode an image of shape {pixels.shape} {pixels.dtype}"
        raise ValueError(msg)
    data = buffer.tobytes()
    if bits is None or bits == pixels.dtype.itemsize * 8:
        return data
    after_header = len(_SIGNATURE) + 12 + 13
    body = b"sBIT" + bytes([bits])
    chunk = struct.pack(">I", 1) + body + struct.pack(">I", zlib.crc32(body))
    return data[:after_header] + chunk + data[after_header:]
