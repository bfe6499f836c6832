"""Pan-tilt heads on a serial line."""
