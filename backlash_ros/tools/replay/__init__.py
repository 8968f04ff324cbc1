"""`replay`: a recorded run through the controller once more."""
