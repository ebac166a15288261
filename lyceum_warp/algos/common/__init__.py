"""Share what learners need: policies, values, buffers, evaluation, processes."""
