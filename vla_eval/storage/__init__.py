"""The files of a run: durable, append-only, checked when read. Knows nothing of what the values mean."""
