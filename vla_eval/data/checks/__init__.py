"""What demonstrations must be like before anything is encoded, trained or compared."""
