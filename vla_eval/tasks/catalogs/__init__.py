"""Rows of tasks that `tasks.catalog` puts together. Importing them starts no simulator."""
