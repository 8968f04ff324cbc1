"""From an output to a command, whatever the driver does: samples, times, counts; no ROS."""
