"""MIKASA-Base: 24 memory environments behind one Gymnasium API. Knows nothing of robots and of runs."""
