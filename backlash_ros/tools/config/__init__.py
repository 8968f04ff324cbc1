"""Parameter files, and the settings of the command line upon them."""
