"""One suite of ordinary rclpy programs, run on the kit and on genuine rclpy, comparing what they decided."""
