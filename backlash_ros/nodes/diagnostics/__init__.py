"""What is wrong, the likeliest cause first, and who else is there."""
