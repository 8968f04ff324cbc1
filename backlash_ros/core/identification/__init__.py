"""Identification: backlash, G(z), delay and noise of an unknown actuator from one record."""
