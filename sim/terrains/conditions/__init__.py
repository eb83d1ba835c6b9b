"""Conditions under which robots cross: payload, weak motors, delays, noise, a push; one file each.

They belong to a terrain, as its ground does.
"""

from sim.terrains.conditions.base import register
from sim.terrains.conditions.delay import ActionDelay
from sim.terrains.conditions.grip import Grip
from sim.terrains.conditions.lag import ObservationLag
from sim.terrains.conditions.motors import MotorStrength
from sim.terrains.conditions.noise import ObservationNoise
from sim.terrains.conditions.payload import Payload
from sim.terrains.conditions.push import Push

for _condition in (Payload(), MotorStrength(), ActionDelay(), ObservationLag(), ObservationNoise(), Push(), Grip()):
    register(_condition)
