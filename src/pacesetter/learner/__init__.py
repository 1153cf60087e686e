"""A compiled learner, the states of its members, and what is around it."""
