"""Mathematics of adaptive backlash inverse control: no ROS, no plotting, no bags."""
