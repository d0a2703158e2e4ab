"""Serialised ROS 2 messages to arrays and back, shared by bags and nodes."""
