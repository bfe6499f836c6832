"""`dcam.toml`: found, read, checked, and what it may hold."""
