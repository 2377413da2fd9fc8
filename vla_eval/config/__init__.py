"""What a person writes in YAML: read strictly into frozen dataclasses. Knows nothing of tasks or policies."""
