"""`bringup`: a whole run as processes."""
