"""Elements of courses: kerbs, steps, stairs, ramps, ditches and the like."""

from sim.terrains.elements.base import register_element
from sim.terrains.elements.raised import KERB, PALLET, RAIL, SILL, STAIRS, STEP
from sim.terrains.elements.slopes import CROSS_SLOPE, FLAT, RAMP
from sim.terrains.elements.sunk import BRIDGE, DITCH, RUBBLE, STONES

for _kind in (FLAT, RAMP, CROSS_SLOPE, SILL, RAIL, KERB, STEP, STAIRS, PALLET, DITCH, BRIDGE, STONES, RUBBLE):
    register_element(_kind)
