"""Run the C engine: MuJoCo itself, with many worlds on a thread pool."""
