"""The second lock: what this process refuses to do, whatever code asks for it (docs/security.md).

An audit hook of Python refuses what the doors of checkpoints and datasets may miss; what the program itself
needs is let through by name. It is not a sandbox. Knows nothing of checkpoints, datasets and verbs.
"""
