"""How a figure was made: the fields that decide whether two figures may stand side by side."""
