"""Whether to believe a measurement: verdicts on one pair, on a burst, on a run of rows."""
