"""The replay: its ring of transitions, transitions over several steps, and how it is sampled."""
