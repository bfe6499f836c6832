"""Errors of the numerics: each says what was wrong, where, and what to do."""

from __future__ import annotations


class CoreError(Exception):
    """Base of everything that `core` raises on purpose; the message is one line."""


class TargetNotFoundError(CoreError):
    """A target is not in the image, or too little of it to be sure which part it is."""


class NotRecognisedError(TargetNotFoundError):
    """A target is in the image, but not as the config describes it; the message names the cure."""


class BadLightError(TargetNotFoundError):
    """No target can be seen in an image that is black or overexposed; the message says the cure."""


class CalibrationError(CoreError):
    """The views given cannot make a calibration; the message names the view or what is missing."""


class NotObservableError(CalibrationError):
    """The motions do not determine the model; the message names the motion that is missing."""


class ImageError(CoreError):
    """An array is not a usable greyscale image."""


class ImageSizeError(ImageError):
    """An image is not of the configured size."""


def digits(value: float, count: int = 3) -> str:
    """Write a number of a message with so many digits and, from 0.0001 on, without an exponent.

    >>> digits(0.70412), digits(17.3), digits(1012.4), digits(1.0)
    ('0.704', '17.3', '1010', '1')
    """
    return f"{float(f'{value:.{count}g}'):.15g}"
