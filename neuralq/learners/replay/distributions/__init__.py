"""What is learned of a return from replay: its mean, or its whole distribution in one of several descriptions."""
