"""Sensor messages as arrays, in order and slice by slice."""
