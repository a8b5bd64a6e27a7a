"""Linear prediction as one affine process: its matrices, its samples and its spectrum."""
