"""Robot models: kinematic tree and inertial parameters, read from and written to URDF and MJCF."""
