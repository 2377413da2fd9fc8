"""The report page: one HTML file that needs no network. Reads results; computes none of its own."""
