"""The version that every row names."""

from __future__ import annotations

from importlib.metadata import version

VERSION = version("dcam")
