"""The central database's history, a branch of its own: PostgreSQL only."""
