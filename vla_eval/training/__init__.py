"""Fine-tuning: a recipe and a dataset become one `TrainingJob`, which `train` brings to its last step."""
