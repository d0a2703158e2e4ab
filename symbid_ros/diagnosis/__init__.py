"""Judge a log: each stream by itself, and all of them against the robot's model."""
