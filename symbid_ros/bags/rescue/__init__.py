"""Whole bags from damaged ones."""
