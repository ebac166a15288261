"""Learn by NPG, PPO or SAC, and plan by sampling: one module for each algorithm, and modules that they share."""
