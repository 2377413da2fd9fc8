"""Statistics and tables from the records of run folders."""
