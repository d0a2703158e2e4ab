"""Recover interrupted and damaged bags: copy intact messages into a new bag."""
