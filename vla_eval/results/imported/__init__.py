"""Results that other programs counted: read, never mixed with measured rows."""
