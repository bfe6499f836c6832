"""What a record of months says: days, temperature, trend, steps and creep, each with its interval.

Times are seconds since 1970 (UTC), displacements mm, readings in their own unit.
"""
