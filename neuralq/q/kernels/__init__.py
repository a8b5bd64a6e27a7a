"""Compiled passes through networks: products, batches and single rows."""
