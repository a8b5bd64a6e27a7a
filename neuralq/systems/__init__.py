"""Whole systems made of the library's parts, one folder each; they know nothing of each other."""
