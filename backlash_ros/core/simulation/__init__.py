"""The whole loop without ROS: simulated, recorded, replayed, and what it achieved."""
