"""Small helpers that know nothing of worlds."""
