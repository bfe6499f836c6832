"""Temperatures and other readings: taken ahead of each slot, beside it and never in its way."""
