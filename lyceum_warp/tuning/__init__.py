"""Find physics options that are faster at equal returns: `lw.tune`."""
