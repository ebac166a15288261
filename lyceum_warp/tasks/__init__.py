"""Define the tasks of the package, one module per task, named after the task."""
