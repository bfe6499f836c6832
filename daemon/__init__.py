"""The field software: schedule, pipeline, store, recovery and commands."""
