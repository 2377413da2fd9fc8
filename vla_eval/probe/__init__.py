"""What a policy remembers, for how long, and whether it acts on it: pairs of worlds. Runs nothing itself."""
