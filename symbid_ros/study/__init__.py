"""Simulation studies that compare methods, priors, filters and logs."""
