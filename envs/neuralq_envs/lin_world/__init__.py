"""Lin's world (1992): an agent among obstacles that looks for food, and four enemies that look for the agent."""
