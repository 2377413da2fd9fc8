"""Scripted players of MIKASA-Base: the best that is known without memory, and with all of it."""
