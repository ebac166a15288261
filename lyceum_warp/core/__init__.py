"""Define the vocabulary: tasks, options, spaces, fields, model files, mirrors and reasons for an end."""
