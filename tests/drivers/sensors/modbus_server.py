"""A Modbus device as pymodbus has it, on a port of this machine or a serial line; `python -m`.

One argument: a serial port; without it, TCP on a free port, whose number is printed.
"""

from __future__ import annotations

import asyncio
import sys
from typing import Any

INPUT = (215, 0xFF38)
"""21.5 and -20.0 degC in tenths."""
HOLDING = (1, 2, 0xFFF6)
FLOAT_AT, FLOAT = 10, 21.5
SWAPPED_AT = 20
"""The same number, its low word first."""
UNIT = 7


def device() -> Any:
    from pymodbus.simulator import DataType, SimData, SimDevice

    bits = [SimData(0, values=[False] * 8, datatype=DataType.BITS)]
    registers = DataType.REGISTERS
    holding = [
        SimData(0, values=list(HOLDING), datatype=registers),
        SimData(FLOAT_AT, values=FLOAT, datatype=DataType.FLOAT32),
        SimData(SWAPPED_AT, values=[0x0000, 0x41AC], datatype=registers),
    ]
    inputs = [SimData(0, values=list(INPUT), datatype=registers)]
    return SimDevice(id=UNIT, simdata=(bits, bits, holding, inputs))


def tell(word: object) -> None:
    sys.stdout.write(f"{word}\n")
    sys.stdout.flush()


async def serve(port: str | None) -> None:
    from pymodbus.server import ModbusSerialServer, ModbusTcpServer

    if port is None:
        server = ModbusTcpServer([device()], address=("127.0.0.1", 0))
        await server.listen()
        tell(server.transport.sockets[0].getsockname()[1])
    else:
        server = ModbusSerialServer([device()], port=port, baudrate=19_200)
        await server.listen()
        tell("ready")
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve(*(sys.argv[1:] or [None])))
