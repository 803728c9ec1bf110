"""What sensors make of a plant's motion: torque from deflection, speed by difference."""
