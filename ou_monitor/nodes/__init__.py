"""The ROS 2 nodes, their executables, and the live page; no other folder imports ROS."""
