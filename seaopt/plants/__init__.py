"""Symbolic CasADi plants: linear and rotary actuators between two links, and a user's own."""

from seaopt.plants.exchange import export_fmu, to_control
from seaopt.plants.friction import let_stick
from seaopt.plants.kinds import KINDS, known_parameters, plant_of_kind
from seaopt.plants.modes import Modes, Resonance, modes
from seaopt.plants.motor.thermal import MotorRating, rate_motor, winding
from seaopt.plants.parts import PARTS, add_part, wrapped
from seaopt.plants.plant import CompletedParameters, Plant, jacobians, state_space
from seaopt.plants.published import thor
from seaopt.plants.roles import Actuation, Friction, Mode, Port, Reading, Sensing, SeriesSpring, Winding
from seaopt.plants.rotary import rotary
from seaopt.plants.sensors.difference import DifferencedSpeed
from seaopt.plants.two_link import high_impedance, moving_output, two_link

__all__ = [
    "KINDS", "PARTS", "Actuation", "CompletedParameters", "DifferencedSpeed", "Friction", "Mode", "Modes",
    "MotorRating", "Plant", "Port", "Reading", "Resonance", "Sensing", "SeriesSpring", "Winding", "add_part",
    "export_fmu", "high_impedance", "jacobians", "known_parameters", "let_stick", "modes", "moving_output",
    "plant_of_kind", "rate_motor", "rotary", "state_space", "thor", "to_control", "two_link", "winding", "wrapped",
]  # fmt: skip
