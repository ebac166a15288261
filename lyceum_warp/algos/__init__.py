"""Learn and plan: NPG, PPO and sampling-based planners, one file each, and the parts that they share."""
