"""Jobs that are computed beside the loop: at once, or in a process of their own."""
