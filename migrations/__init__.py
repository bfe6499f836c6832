"""Database migrations (Alembic); they import none of our code."""
