"""Learn by NPG, PPO or SAC, and plan by sampling: one file for each algorithm, and their common modules."""
