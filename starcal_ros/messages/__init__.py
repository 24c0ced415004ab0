"""Records to ROS message objects and back, without ROS."""
