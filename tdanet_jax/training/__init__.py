"""Learning: the update, the training loop, and a run on disk."""
