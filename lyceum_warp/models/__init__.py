"""Help to prepare models: walking robots, rough ground, actuators."""
