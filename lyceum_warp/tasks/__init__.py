"""Define the tasks of the package, one module each, with the module's name as the name of the task."""
