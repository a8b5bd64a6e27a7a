"""Watching a run for divergence: growth of its errors, and advice."""
