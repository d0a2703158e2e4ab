"""From signals to rows of the equation of motion, folded as they come."""
