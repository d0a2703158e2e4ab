"""Rows to information to estimate."""
