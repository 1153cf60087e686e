"""The training loop and what it keeps: replay, normaliser, population, checkpoints."""
