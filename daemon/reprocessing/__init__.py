"""Frames measured again: in chunks, on as many cores as there are, and in order at the end."""
