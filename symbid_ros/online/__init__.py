"""Whole jobs on messages as they arrive: identify, forget, notice changes."""
