"""Learn by NPG, PPO or SAC, and plan by sampling."""
