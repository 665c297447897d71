"""Output `ros2`: topics of ROS 2 without a ROS installation."""
