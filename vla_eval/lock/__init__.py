"""The second lock: what this process refuses to do, whatever code asks for it.

The doors of checkpoints and datasets let nothing through that runs code. This is for what they may miss: an
audit hook of Python refuses to start programs, to connect, to write outside of the folders that the user
named, and to run Python files that are not installed. What the program itself needs is let through by name.

It is not a sandbox: native code (parquet, FFmpeg, tokenizers) raises no audit event, and Python code that
already runs can get around it. Knows nothing of checkpoints, datasets and verbs.
"""
