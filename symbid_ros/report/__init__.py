"""Estimates to one self-contained page."""
