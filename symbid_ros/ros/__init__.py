"""The nodes; rclpy lives here alone."""
