"""Read text from outside strictly: JSON, YAML, bounds, renamed keys. Knows no file in particular."""
