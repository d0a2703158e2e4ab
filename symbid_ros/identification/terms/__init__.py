"""Joint terms that a log asks for: friction, armature, offsets, springs, couplings and ripples."""
