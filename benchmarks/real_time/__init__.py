"""Programs that load or time the machine, and how their times are taken."""
