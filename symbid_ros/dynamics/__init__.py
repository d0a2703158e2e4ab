"""Rigid-body dynamics: spatial algebra, kinematics, regressors, contact wrenches, IMU motion."""
