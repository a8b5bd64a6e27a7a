"""Compiled loops of the tabular learners."""
