"""Run a node as a process: arguments, parameters, executor, messages, signals, shutdown."""
