"""State of a calibrator between requests, without ROS."""
