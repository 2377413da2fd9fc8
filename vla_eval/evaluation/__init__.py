"""Plan the episodes of a run, hand them to workers, store each record. Names policies by registry string."""
