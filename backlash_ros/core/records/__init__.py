"""Records as people have them: rows with stamps of any kind become v and y on one grid of time."""
