"""Whole jobs on bags: identify, evaluate; the nodes and the commands call these."""
