"""Train a learner, and write and read its run's folder."""
