"""Read the sensor messages of bags as arrays, at once or in slices of time."""
