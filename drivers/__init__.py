"""Cameras, pan-tilt heads, clocks, replayed and simulated, behind small Protocols."""
