"""The mathematics: no data, no files, no ROS."""
