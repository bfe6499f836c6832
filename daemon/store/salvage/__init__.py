"""A damaged database: noticed, set aside, and what can be read carried over."""
