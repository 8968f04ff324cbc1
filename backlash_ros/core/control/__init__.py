"""From y_m and estimates to v: one step of the controller, its structures, (2.2) and (2.3)."""
