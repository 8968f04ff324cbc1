"""`monitor`: running controllers in a terminal."""
