"""What makes a driver good: messages, timing, motion; and how v is moved to see it."""
