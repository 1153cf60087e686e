"""The replay: its ring of rows, rows over several steps, and how rows are sampled."""
