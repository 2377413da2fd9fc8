"""What lies on the table: items, names, places, a mug, the state of a body."""
