"""Rows of MIKASA-Base that `base_tasks.catalog` puts together. Importing them starts no environment."""
