"""Rows that prove themselves: a checksum in each, checked whenever it is read."""
