"""Verdicts on an update: growth, moments, critical values, and what to change."""
