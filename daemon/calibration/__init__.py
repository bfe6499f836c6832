"""Calibrating a site: what to look at, when to expose, what is kept, and what to tell."""
