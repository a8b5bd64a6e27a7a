"""Fitted value iteration with any regressor: what it does, and why it fails where it does."""
