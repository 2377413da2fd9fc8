"""What a training takes: parameters, memory, operations, hours."""
