"""What separates a simulation from a robot: drives, sensors, friction, and what is done to it."""
