"""Which tasks can be won without memory: the controls that need none, on every task. Runs nothing itself."""
