"""The command line: one file per verb; each verb imports what it needs."""
