"""Addresses and values in the camera of `server` and its description `gs3.xml`."""

import struct

# Registers of Aravis' fake camera (arvfakecamera.h), then ours (gs3.xml).
WIDTH, HEIGHT, SENSOR_HEIGHT, SENSOR_WIDTH = 0x100, 0x104, 0x118, 0x11C
OFFSET_X, OFFSET_Y, PIXEL_FORMAT = 0x130, 0x134, 0x128
TEMPERATURE, REVERSE_X, FRAME_RATE_ENABLED, FRAME_RATE_AUTO = 0xB000, 0xB008, 0xB00C, 0xB010
TRIGGER_SELECTOR, EXPOSURE_AUTO, EXPOSURE_TIME = 0xB014, 0xB01C, 0xB020
GAIN_AUTO, GAIN, GAMMA_ENABLED, GAMMA = 0xB028, 0xB030, 0xB038, 0xB040
TRIGGER_SOURCE, TRIGGER_ACTIVATION, LINE_MODE, LINE_SOURCE = 0xB048, 0xB04C, 0xB060, 0xB070
TRIGGER_MODE, WAITS_FOR_TRIGGER, FIRE = 0x300, 0x304, 0x30C
CONTROL = 0xA00
"""Who controls the camera (GigE Vision 2.0, 28.16: Control Channel Privilege); 0 is nobody."""
OUTPUT, EXPOSURE_ACTIVE, RISING_EDGE = 1, 1, 1
LINES = range(4)
SOFTWARE = 1


def double_words(value: float) -> tuple[int, int]:
    """A number as the two registers that hold it."""
    high, low = struct.unpack(">II", struct.pack(">d", value))
    return high, low


def packed(value: float) -> bytes:
    """A number as it stands in a register: a float in 8 bytes, an integer in 4."""
    return struct.pack(">d" if isinstance(value, float) else ">I", value)


def after_power_up(width: int, height: int) -> dict[int, int | float]:
    """Give the registers of a GS3 after power-up: automatic modes and gamma on."""
    return {
        SENSOR_WIDTH: width,
        SENSOR_HEIGHT: height,
        WIDTH: width,
        HEIGHT: height,
        FRAME_RATE_ENABLED: 1,
        FRAME_RATE_AUTO: 2,
        EXPOSURE_AUTO: 2,
        GAIN_AUTO: 2,
        GAMMA_ENABLED: 1,
        TRIGGER_SELECTOR: 1,
        REVERSE_X: 1,
        WAITS_FOR_TRIGGER: 1,
        TRIGGER_SOURCE: 0,
        LINE_MODE + 4: OUTPUT,
        EXPOSURE_TIME: 6118.0,
        GAIN: 12.5,
        GAMMA: 1.25,
        TEMPERATURE: 41.5,
    }
