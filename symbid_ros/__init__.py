"""Identification of inertial and friction parameters on ROS 2."""
