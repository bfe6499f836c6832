"""Each table's rows: from records and back, and their own SQL."""
