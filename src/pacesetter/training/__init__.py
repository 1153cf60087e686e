"""A run: the trainer, its checkpoints, and the on-policy loop."""
