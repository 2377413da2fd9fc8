"""Fine-tuning: a recipe and a dataset go into lerobot's own training loop."""
