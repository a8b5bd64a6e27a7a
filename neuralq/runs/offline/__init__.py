"""Learning from experience that was recorded before: data sets, training on them, evaluating a policy by them."""
