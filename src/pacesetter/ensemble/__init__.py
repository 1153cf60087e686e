"""The members of a run: their loop, the selection among them, rules and counters."""
