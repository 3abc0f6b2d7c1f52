"""Onboard computations, without ROS: samples -> window -> estimate -> risk and cutoff."""
