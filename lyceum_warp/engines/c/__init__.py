"""The C engine: MuJoCo itself, many worlds on a pool of threads."""
