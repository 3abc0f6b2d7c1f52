"""The ROS 2 nodes, executables and the live page; no other folder imports ROS."""
