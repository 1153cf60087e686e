"""Runs read, grouped and compared."""
