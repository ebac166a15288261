"""Tasks that come with the package, one module each; the module's name is the task's."""
