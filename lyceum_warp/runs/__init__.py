"""Write and read the folder of a run: its files, its copy of the task, its checkpoints."""
