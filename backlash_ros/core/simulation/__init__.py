"""The whole loop without ROS: simulation, records, replay, and figures of merit."""
