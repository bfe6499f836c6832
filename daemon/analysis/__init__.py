"""The series of the record brought to the numerics that analyse them."""
