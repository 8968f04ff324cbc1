"""Parts of check_driver: its options, and what discovery tells of a driver."""
