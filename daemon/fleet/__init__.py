"""Many piers: one record of all in a central database."""
