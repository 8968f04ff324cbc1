"""What the command lines of all tools share."""
