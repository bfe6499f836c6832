"""A sensor with a Modbus register, over TCP or a serial line."""

from __future__ import annotations

import logging
import math
import time
from typing import Any

from drivers.errors import SensorError
from drivers.libraries import require_library
from drivers.sensors.modbus_url import ModbusAddress

_PARITIES = {"none": "N", "even": "E", "odd": "O"}
_TRY_AGAIN_S = 0.05
"""Between two attempts at a serial port that another program holds just now: `dcam-ctl check`."""
_REFUSALS = {
    1: "knows no such function",
    2: "has no such register",
    3: "refuses the number of registers",
    4: "has failed",
    6: "is busy",
    10: "is not reached: the gateway has no way to it",
    11: "does not answer the gateway",
}


def load_pymodbus() -> tuple[Any, Any]:
    """Give pymodbus's clients and framings, its log silenced. Raises MissingLibraryError."""
    require_library("pymodbus", "Modbus")
    from pymodbus import FramerType, client

    # What goes wrong is said once, by us.
    for name in ("pymodbus.logging", "pymodbus_internal"):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    return client, FramerType


class ModbusSensor:
    """Connects, reads, disconnects; implements `Sensor`."""

    def __init__(self, address: ModbusAddress) -> None:
        self._address = address

    @property
    def bus(self) -> str:
        """The line or the host: one reading at a time."""
        return self._address.bus

    def read(self, timeout_s: float) -> float:
        """Give the registers' number. Raises SensorError, MissingLibraryError."""
        address = self._address
        where = f"unit {address.unit} at {address.bus}"
        client = self._connected(timeout_s)
        read = client.read_input_registers
        if address.table == "holding":
            read = client.read_holding_registers
        try:
            answer = read(address.register, count=address.count, device_id=address.unit)
        except Exception as error:  # pymodbus, pyserial and sockets raise their own
            msg = f"{where}: no answer within {timeout_s:g} s"
            raise SensorError(msg) from error
        finally:
            client.close()
        if answer.isError():
            code = int(getattr(answer, "exception_code", 0))
            msg = f"{where} {_REFUSALS.get(code, f'refuses (Modbus exception {code})')}"
            raise SensorError(msg)
        try:
            value = address.value(answer.registers)
        except ValueError as error:
            msg = f"{where}: {error}"
            raise SensorError(msg) from None
        if not math.isfinite(value):
            msg = f"{where} says {value}, not a number"
            raise SensorError(msg)
        return value

    def stop(self) -> None:
        """Do nothing: a read ends by its deadline."""

    def _connected(self, timeout_s: float) -> Any:
        """A client with its line open. Raises SensorError."""
        ends_s = time.monotonic() + timeout_s
        while True:
            client = self._new_client(max(ends_s - time.monotonic(), _TRY_AGAIN_S))
            if client.connect():
                return client
            client.close()
            if self._address.host is not None or time.monotonic() > ends_s:
                break
            time.sleep(_TRY_AGAIN_S)
        why = "nothing answers there" if self._address.host else "cannot be opened, or is in use"
        msg = f"{self._address.bus}: {why}"
        raise SensorError(msg)

    def _new_client(self, timeout_s: float) -> Any:
        address, (clients, framer) = self._address, load_pymodbus()
        if address.host is None:
            return clients.ModbusSerialClient(
                address.device,
                baudrate=address.baud,
                parity=_PARITIES[address.parity],
                stopbits=address.stop_bits,
                timeout=timeout_s,
                retries=0,
            )
        return clients.ModbusTcpClient(
            address.host,
            port=address.port,
            framer=framer.RTU if address.rtu_over_tcp else framer.SOCKET,
            timeout=timeout_s,
            retries=0,
        )
