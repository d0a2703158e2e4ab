"""Comparisons over data sets, priors and methods."""
