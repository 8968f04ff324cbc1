"""Command-line tools: they start nodes as processes, simulate, analyse and draw."""
