"""Learned models of a task, and the rewards that are known."""
