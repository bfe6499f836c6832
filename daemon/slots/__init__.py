"""Slot after slot: captured, stored, measured, recorded; and put right after a stop."""
