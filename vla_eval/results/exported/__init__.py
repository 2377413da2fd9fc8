"""Results for other programs: a file with a schema, and model cards."""
