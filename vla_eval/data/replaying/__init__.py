"""Execute a dataset's actions again and compare. Knows nothing of who recorded it."""
