"""What the default law does with its fit, and when: from the first search to a change."""
