"""Loops that are compiled: the work that is done for every contact."""
