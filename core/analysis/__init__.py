"""What a record says over days and years: trend, temperature, creep, steps, comparison."""
