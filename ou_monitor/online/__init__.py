"""What runs on the craft, without ROS: samples -> window -> estimate -> risk and cutoff."""
