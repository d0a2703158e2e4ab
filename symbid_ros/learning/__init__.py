"""A robot that learns its own model while it stands: gate, safe moves, and a run in lockstep."""
