"""The weights of a model: read from a file one by one, put in exactly, trained in part. Knows only torch."""
