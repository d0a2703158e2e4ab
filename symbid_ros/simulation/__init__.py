"""MuJoCo plant, balance controller, sensors."""
