"""The central PostgreSQL database of many piers: the only place that knows its driver."""
