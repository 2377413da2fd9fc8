"""Published results and protocols, for tables below a success table."""
