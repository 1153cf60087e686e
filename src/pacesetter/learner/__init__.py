"""One learner as a compiled program, and what is around it: backend, precision, normaliser."""
