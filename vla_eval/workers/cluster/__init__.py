"""The backend of a Ray cluster. Ray is imported by `connect` alone, when it is asked for."""
