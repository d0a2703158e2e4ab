"""Estimation: from rows of the equation of motion to information, posterior and verdict."""
