"""Scripts that make the shipped checkpoints again."""
