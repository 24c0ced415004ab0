"""Queue and rates of the star observer, without ROS."""
