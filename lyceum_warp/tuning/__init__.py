"""Find physics options that are faster and do not change the returns: `lw.tune`."""
