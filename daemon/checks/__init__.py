"""What must be right before the first slot: one module a theme, each gives findings."""
