"""Errors of sensors and drives as further unknowns."""
