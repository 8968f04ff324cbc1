"""What `monitor` and `live` share: running controllers, and how they are shown."""
