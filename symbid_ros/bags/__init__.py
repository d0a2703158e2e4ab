"""MCAP bags in and out; knows arrays and bytes, not robots."""
