"""Learn and plan: NPG, PPO and sampling-based planners, one file each, beside the parts that they share."""
