"""The quality ledger: what people say of spans of the record."""
