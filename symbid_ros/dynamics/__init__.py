"""Spatial algebra, forward kinematics, regressor, wrenches, centroidal quantities."""
