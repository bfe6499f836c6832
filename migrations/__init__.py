"""The database's history: Alembic revisions, run by `daemon.store.migrate`."""
