"""Statistics and tables from the records of run folders. Knows nothing of simulators, models or pages."""
