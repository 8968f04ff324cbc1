"""What pages and pictures of all tools are made with."""
