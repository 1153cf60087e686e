"""Read, group and compare runs."""
