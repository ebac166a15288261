"""Run one task in many worlds: environments, open-loop rollouts, curricula."""
