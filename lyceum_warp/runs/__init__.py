"""A run: the files in its folder, its copy of the task, and when it is saved."""
