"""Write and read run folders: their files, their copy of the task, their checkpoints."""
