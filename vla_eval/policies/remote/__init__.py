"""A policy behind a socket: names, sizes and conventions of both ends. Knows no model and no simulator."""
