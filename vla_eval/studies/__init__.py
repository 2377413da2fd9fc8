"""Tables of many policies: train, evaluate, resume, on a pool or a cluster. Knows no terminal."""
