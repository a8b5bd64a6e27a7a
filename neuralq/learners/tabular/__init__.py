"""The chapter's algorithms on a table, in the compiled loops of `neuralq.tabular`, as a learner that runs know."""
