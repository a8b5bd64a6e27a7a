"""Learning from stored experience: the buffer, the settings, and the learners that draw from it."""
