"""A run's network as a file for other programs, checked against the values that the run itself computes."""
