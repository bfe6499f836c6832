"""Tells people that something is wrong, whether dcamd lives or not."""
