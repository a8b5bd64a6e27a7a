"""Learning one step at a time with eligibility traces."""
