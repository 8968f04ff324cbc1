"""What `check_driver` and `identify --drive` share: a driver is heard, v moved to and fro."""
