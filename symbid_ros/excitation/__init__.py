"""Excitation trajectories: designed for the most information before a robot moves."""
