"""Kinematic tree and inertial parameters; URDF and MJCF in and out."""
