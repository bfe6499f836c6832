"""Where a Modbus sensor is and how its registers are read, as one line of the config.

tcp://192.168.1.5?unit=1&register=30001&type=int16
serial:///dev/ttyUSB1?baud=9600&parity=none&unit=3&holding=256&type=float32&words=low-first
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args
from urllib.parse import SplitResult, parse_qsl, urlsplit

NumberType = Literal["int16", "uint16", "int32", "uint32", "float32"]
Table = Literal["holding", "input"]
Parity = Literal["none", "even", "odd"]
WordOrder = Literal["high-first", "low-first"]

_PACKED: Mapping[NumberType, str] = {
    "int16": ">h",
    "uint16": ">H",
    "int32": ">i",
    "uint32": ">I",
    "float32": ">f",
}
_REGISTER = ("register", "holding", "input")
_OF_BOTH = ("unit", *_REGISTER, "type", "words")
_OPTIONS = {"tcp": (*_OF_BOTH, "framing"), "serial": (*_OF_BOTH, "baud", "parity", "stop_bits")}
_LAST = 65_535
_SHAPES = "tcp://HOST?... or serial:///dev/...?..."


@dataclass(frozen=True, slots=True)
class ModbusAddress:
    """One number in a Modbus device, and the way there."""

    host: str | None
    """None: a serial line."""
    port: int
    device: str
    """The serial port; empty over TCP."""
    baud: int
    parity: Parity
    stop_bits: int
    rtu_over_tcp: bool
    """Whether the bytes of a serial line travel over TCP as they are."""
    unit: int
    table: Table
    register: int
    """As it travels: from 0."""
    kind: NumberType
    words: WordOrder
    """Which half of a number of 32 bits stands in the first register."""

    @property
    def bus(self) -> str:
        """What one reading at a time may use."""
        return self.device or f"{self.host}:{self.port}"

    @property
    def count(self) -> int:
        """How many registers."""
        return struct.calcsize(_PACKED[self.kind]) // 2

    def value(self, registers: Sequence[int]) -> float:
        """The number in the registers. Raises ValueError for another number of them."""
        if len(registers) != self.count:
            msg = f"{len(registers)} registers came, not {self.count}"
            raise ValueError(msg)
        ordered = registers if self.words == "high-first" else registers[::-1]
        packed = b"".join(register.to_bytes(2, "big") for register in ordered)
        (number,) = struct.unpack(_PACKED[self.kind], packed)
        return float(number)


def parse_modbus(text: str) -> ModbusAddress:
    """Read such a line. Raises ValueError: what is wrong and what may be there."""
    parts = urlsplit(text)
    if parts.scheme not in _OPTIONS:
        msg = f"must be {_SHAPES}"
        raise ValueError(msg)
    options = _options(parts)
    table, register = _register(options)
    kind = _chosen(options, "type", get_args(NumberType))
    host, port = _host(parts) if parts.scheme == "tcp" else (None, 0)
    if parts.scheme == "serial" and (parts.netloc or not parts.path.startswith("/dev/")):
        msg = "needs the port with three slashes, as serial:///dev/ttyUSB1"
        raise ValueError(msg)
    address = ModbusAddress(
        host=host,
        port=port,
        device=parts.path if host is None else "",
        baud=_whole(options, "baud", 300, 921_600, "9600"),
        parity=_chosen(options, "parity", get_args(Parity), "none"),
        stop_bits=_whole(options, "stop_bits", 1, 2, "1"),
        rtu_over_tcp=_chosen(options, "framing", ("tcp", "rtu"), "tcp") == "rtu",
        unit=_whole(options, "unit", 0, 255, "1"),
        table=table,
        register=register,
        kind=kind,
        words=_chosen(options, "words", get_args(WordOrder), "high-first"),
    )
    if address.register + address.count - 1 > _LAST:
        msg = f"register {register} is the last one, and {kind} takes two"
        raise ValueError(msg)
    return address


def _options(parts: SplitResult) -> dict[str, str]:
    known = _OPTIONS[parts.scheme]
    pairs = parse_qsl(parts.query, keep_blank_values=True)
    options = dict(pairs)
    if len(options) < len(pairs):
        msg = "names an option twice; keep one"
        raise ValueError(msg)
    for name in options:
        if name not in known:
            msg = f'has an unknown option "{name}"; known here: {", ".join(known)}'
            raise ValueError(msg)
    if parts.fragment:
        msg = f"has a # in it; must be {_SHAPES}"
        raise ValueError(msg)
    return options


def _host(parts: SplitResult) -> tuple[str, int]:
    try:
        port = parts.port
    except ValueError:
        port = 0
    if not parts.hostname or port == 0 or parts.username or parts.path.strip("/"):
        msg = "needs a host and no path, as tcp://192.168.1.5:502?unit=1&register=30001&type=int16"
        raise ValueError(msg)
    return parts.hostname, port or 502


def _register(options: Mapping[str, str]) -> tuple[Table, int]:
    """Table and address from 0, of `holding=`, `input=`, or a manual's number such as 30001."""
    given = [name for name in _REGISTER if name in options]
    if len(given) != 1:
        msg = (
            "needs one of register=30001 (40001 ...; as the device's manual counts), input=0 or "
            "holding=0 (as it counts from 0)"
        )
        raise ValueError(msg)
    if given == ["holding"]:
        return "holding", _whole(options, "holding", 0, _LAST)
    if given == ["input"]:
        return "input", _whole(options, "input", 0, _LAST)
    text = options["register"]
    tables: Mapping[str, Table] = {"3": "input", "4": "holding"}
    table = tables.get(text[:1])
    number = int(text[1:]) if text[1:].isdecimal() and text.isascii() else 0
    if table is None or len(text) not in {5, 6} or not 1 <= number <= _LAST + 1:
        msg = (
            f"register={text}: must be 30001 and up for an input register or 40001 and up for a "
            "holding register"
        )
        raise ValueError(msg)
    return table, number - 1


def _whole(
    options: Mapping[str, str], name: str, low: int, high: int, default: str | None = None
) -> int:
    text = options.get(name, default or "")
    if not (text.isascii() and text.isdecimal()) or not low <= int(text) <= high:
        msg = f"{name}={text}: must be a whole number from {low} to {high}"
        raise ValueError(msg)
    return int(text)


def _chosen(
    options: Mapping[str, str], name: str, choices: Sequence[str], default: str | None = None
) -> Any:
    text = options.get(name, default)
    if text is None:
        msg = f"needs {name}=, one of {', '.join(choices)}"
        raise ValueError(msg)
    if text not in choices:
        msg = f"{name}={text}: must be one of {', '.join(choices)}"
        raise ValueError(msg)
    return text
