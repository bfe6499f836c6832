"""What Alembic runs for every command: work on the connection, and in the transaction, handed in.

The caller owns both, so that an upgrade cut off half way leaves the database as it was.
"""

from __future__ import annotations

from alembic import context

context.configure(
    connection=context.config.attributes["connection"],
    target_metadata=context.config.attributes.get("target_metadata"),
    render_as_batch=True,  # SQLite cannot alter most of a table in place
)
context.run_migrations()
