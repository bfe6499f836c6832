"""Modbus registers, read from a real server over TCP and over a serial line."""

from __future__ import annotations

import os
import pty
import selectors
import subprocess
import sys
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from drivers.errors import MissingLibraryError, SensorError
from drivers.sensors.modbus import ModbusSensor
from drivers.sensors.modbus_url import parse_modbus
from tests.drivers.sensors.modbus_server import (
    FLOAT,
    FLOAT_AT,
    HOLDING,
    INPUT,
    SWAPPED_AT,
    UNIT,
)

ROOT = Path(__file__).parents[3]
PATIENT_S = 60.0
READ = {
    f"unit={UNIT}&register=30001&type=int16": INPUT[0],
    f"unit={UNIT}&input=1&type=int16": INPUT[1] - 65536,
    f"unit={UNIT}&input=1&type=uint16": INPUT[1],
    f"unit={UNIT}&holding=2&type=int16": HOLDING[2] - 65536,
    f"unit={UNIT}&register=400003&type=int16": HOLDING[2] - 65536,
    f"unit={UNIT}&register=40001&type=uint32": 0x10002,
    f"unit={UNIT}&register=40001&type=int32&words=low-first": 0x20001,
    f"unit={UNIT}&holding={FLOAT_AT}&type=float32": FLOAT,
    f"unit={UNIT}&holding={SWAPPED_AT}&type=float32&words=low-first": FLOAT,
}


def read(url: str, timeout_s: float = PATIENT_S) -> float:
    return ModbusSensor(parse_modbus(url)).read(timeout_s)


@contextmanager
def served(*arguments: str) -> Iterator[str]:
    """A server process, and the line that it prints when it listens."""
    command = [sys.executable, "-m", "tests.drivers.sensors.modbus_server", *arguments]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process.stdout.readline().strip()
        finally:
            process.kill()


@pytest.fixture(scope="module")
def tcp() -> Iterator[str]:
    """What begins the address of a server."""
    with served() as port:
        yield f"tcp://127.0.0.1:{port}?"


@contextmanager
def serial_line() -> Iterator[tuple[str, str]]:
    """Two serial ports with a wire between them."""
    (here, one), (there, other) = pty.openpty(), pty.openpty()
    for end in (here, one, there, other):
        tty.setraw(end)
    over = threading.Event()

    def carry() -> None:
        with selectors.DefaultSelector() as selector:
            for source, sink in ((here, there), (there, here)):
                selector.register(source, selectors.EVENT_READ, sink)
            while not over.is_set():
                for key, _ in selector.select(0.05):
                    os.write(key.data, os.read(key.fd, 1000))

    wire = threading.Thread(target=carry, daemon=True)
    wire.start()
    try:
        yield os.ttyname(one), os.ttyname(other)
    finally:
        over.set()
        wire.join()
        for end in (here, one, there, other):
            os.close(end)


@pytest.mark.parametrize(("query", "value"), READ.items())
def test_a_register_is_read_over_tcp(tcp: str, query: str, value: float) -> None:
    assert read(tcp + query) == value


def test_a_register_is_read_over_a_serial_line() -> None:
    with serial_line() as (ours, theirs), served(theirs) as said:
        assert said == "ready"
        for query, value in READ.items():
            assert read(f"serial://{ours}?baud=19200&{query}") == value


def test_a_serial_port_in_use_is_waited_for_and_then_named() -> None:
    """As when `dcam-ctl check` and dcamd read at once."""
    with serial_line() as (ours, _):
        import serial

        with serial.Serial(ours, exclusive=True), pytest.raises(SensorError, match="is in use"):
            read(f"serial://{ours}?register=30001&type=int16", 0.2)


def test_who_does_not_answer_is_named() -> None:
    with (
        serial_line() as (ours, _),
        pytest.raises(SensorError, match=rf"unit 3 at {ours}: no answer within 0.3 s"),
    ):
        read(f"serial://{ours}?unit=3&register=30001&type=int16", 0.3)


def test_a_device_that_refuses_is_named(tcp: str) -> None:
    with pytest.raises(SensorError, match=rf"unit {UNIT} at 127.0.0.1:\d+ has no such register"):
        read(f"{tcp}unit={UNIT}&register=49999&type=int16")


def test_a_port_where_nothing_listens_is_named() -> None:
    with pytest.raises(SensorError, match=r"127\.0\.0\.1:1: nothing answers there"):
        read("tcp://127.0.0.1:1?register=30001&type=int16")


def test_without_pymodbus_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymodbus", None)
    says = r"^no Modbus: pymodbus is not installed; .*pip install 'pymodbus[^']*'$"
    with pytest.raises(MissingLibraryError, match=says):
        read("tcp://127.0.0.1:1?register=30001&type=int16")


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("192.168.1.5:502", "must be tcp://HOST"),
        ("rtu://192.168.1.5", "must be tcp://HOST"),
        ("tcp://192.168.1.5:502/1/30001?type=int16", "needs one of register="),
        ("tcp://h/1?register=30001&type=int16", "needs a host and no path"),
        ("tcp://h:0?register=30001&type=int16", "needs a host"),
        ("tcp://?register=30001&type=int16", "needs a host"),
        ("tcp://h?register=30001", "needs type=, one of int16, uint16"),
        ("tcp://h?register=30001&type=int64", "type=int64: must be one of"),
        ("tcp://h?register=10001&type=int16", "register=10001: must be 30001 and up"),
        ("tcp://h?register=30000&type=int16", "register=30000: must be 30001 and up"),
        ("tcp://h?register=3000&type=int16", "register=3000: must be 30001 and up"),
        ("tcp://h?register=30001&holding=0&type=int16", "needs one of register="),
        ("tcp://h?holding=65536&type=int16", "holding=65536: must be a whole number from 0"),
        ("tcp://h?holding=65535&type=int32", "register 65535 is the last one"),
        ("tcp://h?holding=-1&type=int16", "holding=-1: must be a whole number"),
        ("tcp://h?unit=256&holding=0&type=int16", "unit=256: must be a whole number from 0 to 255"),
        ("tcp://h?unit=1&unit=2&holding=0&type=int16", "names an option twice"),
        ("tcp://h?baud=9600&holding=0&type=int16", 'has an unknown option "baud"'),
        ("tcp://h?holding=0&type=int16&words=big", "words=big: must be one of high-first"),
        ("serial://dev/ttyUSB1?holding=0&type=int16", "needs the port with three slashes"),
        ("serial:///dev/ttyUSB1?baud=1&holding=0&type=int16", "baud=1: must be a whole number"),
        ("serial:///dev/ttyUSB1?parity=N&holding=0&type=int16", "parity=N: must be one of none"),
    ],
)
def test_an_address_that_is_none_says_what_may_be_there(url: str, says: str) -> None:
    with pytest.raises(ValueError, match=says.replace("?", r"\?")):
        parse_modbus(url)
