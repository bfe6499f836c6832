"""How bright a target is, and how to expose the next slot."""
