"""Fine-tuning: a recipe and a dataset become one `TrainingJob`, which `train` runs to its last step."""
