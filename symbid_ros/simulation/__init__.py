"""Simulation of the robot: MuJoCo plant, balance controller, sensors and their errors."""
