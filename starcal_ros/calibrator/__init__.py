"""What a calibrator keeps between requests, without ROS."""
