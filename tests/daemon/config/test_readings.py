"""`[[reading]]`: what is wrong with a sensor's lines is said in one line each, with the key."""

from __future__ import annotations

from pathlib import Path

import pytest

from daemon.config.reading import load_config
from daemon.errors import ConfigError
from tests.laboratory import laboratory

SITE = laboratory(320)
AIR = '[[reading]]\nname = "air"\nunit = "degC"\n'
FILE = 'file = "/sys/x"\n'


def config_of(directory: Path, text: str) -> Path:
    path = directory / "dcam.toml"
    path.write_text(SITE + text)
    return path


def test_readings_are_read_with_their_defaults(tmp_path: Path) -> None:
    """A relative path is beside the config; none of it changes what rows are measured with."""
    path = config_of(
        tmp_path,
        AIR + 'file = "here"\n[[reading]]\nname = "2-deck"\nunit = "%"\ncommand = ["a", "b"]\n'
        'timeout_s = 30.0\n[[reading]]\nname = "w"\nunit = "m/s"\n'
        'modbus = "tcp://h?register=30001&type=int16"\n',
    )
    config = load_config(path)
    air, deck, wind = config.reading
    assert (air.source, air.scale, air.offset, air.min, air.max, air.timeout_s) == (
        *(tmp_path / "here", 1.0, 0.0, None, None, 5.0),
    )
    assert deck.source == ("a", "b")
    assert wind.source.host == "h"
    assert config.config_hash() == load_config(config_of(tmp_path, "")).config_hash()


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (AIR, "reading[0].name: 'air' gives no source; give one of file, command, modbus"),
        (
            AIR + FILE + 'command = ["x"]\n',
            "reading[0].name: 'air' gives file and command; give one of file, command, modbus",
        ),
        (
            AIR + FILE + AIR + FILE,
            "reading[1].name: 'air' is that of another reading too; give each its own",
        ),
        (
            AIR.replace("air", "Air") + FILE,
            "reading[0].name: must be made of a-z, 0-9 and -, at most 32, is 'Air'",
        ),
        (
            AIR.replace("air", "a" * 33) + FILE,
            f"reading[0].name: must be made of a-z, 0-9 and -, at most 32, is '{'a' * 33}'",
        ),
        (
            AIR.replace("degC", "degrees Celsius here") + FILE,
            "reading[0].unit: must have at most 16 characters, is 'degrees Celsius here'",
        ),
        (
            AIR.replace("degC", " ") + FILE,
            "reading[0].unit: must be a word such as degC, is ' '",
        ),
        (AIR + FILE + "scale = 0.0\n", "reading[0].scale: must not be 0"),
        (AIR + FILE + "min = 5.0\nmax = 5.0\n", "reading[0].min: must be less than max = 5, is 5"),
        (
            AIR + FILE + "timeout_s = 31.0\n",
            "reading[0].timeout_s: must be at most half of schedule.period_s = 60, is 31",
        ),
        (
            AIR + FILE + "[schedule]\nperiod_s = 2\n",
            "reading[0].timeout_s: must be at most half of schedule.period_s = 2, is 5",
        ),
        (AIR + "command = []\n", "reading[0].command: must have at least 1 values, has 0"),
        (AIR + 'command = "date"\n', "reading[0].command: must be a list, is 'date'"),
        (AIR + 'path = "/x"\n', "reading[0].path: unknown key"),
        (
            AIR + 'modbus = "tcp://h?unit=1&type=int16"\n',
            'reading[0].modbus: "tcp://h?unit=1&type=int16" needs one of register=30001',
        ),
        (
            AIR + 'modbus = "serial:///dev/ttyUSB0?holding=0&type=int16"\n'
            '[pan_tilt]\nbackend = "ptu"\nport = "/dev/ttyUSB0"\n',
            "reading[0].modbus: /dev/ttyUSB0 is the pan-tilt head's port",
        ),
        (
            AIR + 'file = "/sys/air"\n[stability]\ntemperature_reading = "steel"\n',
            "stability.temperature_reading: there is no reading 'steel'; known: air",
        ),
        (
            AIR.replace("degC", "hPa")
            + 'file = "/sys/air"\n[stability]\ntemperature_reading = "air"\n',
            "stability.temperature_reading: 'air' is in 'hPa'; a temperature is in degC or K",
        ),
    ],
)
def test_what_is_wrong_is_said_with_its_key(tmp_path: Path, text: str, problem: str) -> None:
    path = config_of(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    (found,) = caught.value.problems
    assert found.startswith(f"{path}: {problem}")
