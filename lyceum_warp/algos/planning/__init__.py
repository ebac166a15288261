"""Plan by sampling: MPPI, CEM and predictive sampling."""
