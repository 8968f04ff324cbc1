"""A node as a process: arguments, parameters, executor, life, signals, end."""
