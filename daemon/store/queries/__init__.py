"""What programs and people ask of the record: plain SQL, many rows at once, one moment."""
