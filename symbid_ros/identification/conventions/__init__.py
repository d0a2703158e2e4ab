"""What a log says of its own conventions: signs, units, gravity and contacts."""
