"""The measurements of an examination: E environment, V values, R network, D data."""
