"""The command line: one file per verb, which reads flags and prints. Knows no statistics and no models."""
