"""What drives an actuator: its motor, as it warms up."""
