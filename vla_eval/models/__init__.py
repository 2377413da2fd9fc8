"""The networks: a folder per model family, and what they share. Knows no simulators and no runs."""
